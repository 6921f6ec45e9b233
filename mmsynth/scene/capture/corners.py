"""Corners of squares refined on the photosites: a model of two crossing edges fitted to the pixels around each corner.

With p and q [px] the distances of a pixel from the two edges and σ the blur of lens and photosite,

    I = a + g·x + b erf(p / σ√2) erf(q / σ√2)

Nine parameters by Gauss-Newton in float64, all corners at once: the crossing (2), the directions of the edges (2), σ, a, b and g (2). The
model is symmetric about the crossing, as is a tone curve's effect on it, so neither a blur nor a gamma moves the corner.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

_WINDOW = 12  # pixels from the corner at the most: edges are straight there
_REACH = 0.42  # of a square
_CLEAR = 1.5  # pixels that a marker's edge blurs into its white square
_STEPS = 25
_AWAY = 0.3  # of a square's shortest side [px] by which a corner may move, or two pixels


def refine_saddles(
    picture: np.ndarray, weight: np.ndarray, pixels: np.ndarray, across: np.ndarray, clear: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners to a few hundredths of a pixel.

    Args:
        picture: (H, W) float, channels at one level; weight: (H, W) ≥ 0, of its pixels.
        pixels: (N, 2) where corners are, to a pixel or two; across: (N, 2, 2) pixels for one square to the right and one down, in columns.
        clear: distance from the edges [squares] up to which white squares are plain: beyond it there are markers.
    Returns:
        (N, 2) pixels, NaN where there is no such corner; (N,) their standard deviation [px] by the pixels' scatter around the model; and
        (N,) 1 where the squares to the upper left and lower right of the board's axes are the white ones, else -1.
    """
    height, width = picture.shape
    flat = np.abs(np.linalg.det(across)) < 2.0  # px²: seen edge on, or misread
    across = np.where(flat[:, None, None], np.eye(2), across)
    side = np.linalg.norm(across, axis=1).min(1)  # (N,) pixels
    reach = int(np.clip(np.ceil(_REACH * np.sqrt(2) * np.median(side)), 2, _WINDOW))
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, 1, -1)
    centre = np.rint(pixels).astype(int)
    u, v = centre[:, :1] + du, centre[:, 1:] + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    at = np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)
    value, grain = picture[at].astype(np.float64), weight[at] * inside
    x = np.stack([u, v], -1).astype(np.float64)

    board = np.einsum("nij,nkj->nki", np.linalg.inv(across), x - pixels[:, None])  # squares from the corner
    near = np.abs(board).max(-1) < _REACH
    # where the two white squares are: the brighter pair of opposite quadrants
    sign = np.sign(board[..., 0] * board[..., 1])
    far = near & (np.abs(board).min(-1) > 0.5 / side[:, None])
    pair = [(value * (far & (sign == s)) * grain).sum(1) / np.maximum(((far & (sign == s)) * grain).sum(1), 1e-12) for s in (1, -1)]
    white = np.where(pair[0] > pair[1], 1.0, -1.0)
    margin = clear - _CLEAR / side
    plain = (sign != white[:, None]) | (np.abs(board).min(-1) < margin[:, None])
    mask = grain * (near & plain)

    normal = np.linalg.inv(across)  # rows: normals of the two edges
    angle = np.arctan2(normal[:, :, 1], normal[:, :, 0])
    scale = np.maximum(np.abs(pair[0] - pair[1]) / 2, 1e-9)
    value = (value - ((pair[0] + pair[1]) / 2)[:, None]) / scale[:, None]
    parameters = np.concatenate([pixels, angle, np.full((len(pixels), 1), np.log(0.8)), np.zeros((len(pixels), 4))], 1)
    parameters[:, 6] = white
    parameters, covariance, residual = _gauss_newton(parameters, x, value, mask)

    moved = np.linalg.norm(parameters[:, :2] - pixels, axis=1)
    good = (moved < np.maximum(2.0, _AWAY * side)) & (parameters[:, 6] * white > 0.3) & (residual < 0.4)
    good &= ~flat & ((mask > 0).sum(1) > 14) & (parameters[:, 4] < 1.6)
    turned = np.sin(parameters[:, 3] - parameters[:, 2]) / np.sin(angle[:, 1] - angle[:, 0])
    good &= np.isfinite(moved) & (turned > 0.3)
    return np.where(good[:, None], parameters[:, :2], np.nan), np.sqrt(np.maximum(covariance, 0.0)), white


def _gauss_newton(p: np.ndarray, x: np.ndarray, value: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (N, 9), mean variance of the crossing's coordinates (N,), rms of the residual in units of the contrast (N,)."""
    damping = np.full(len(p), 1e-3)
    model, jacobian = _edges(p, x)
    cost = (mask * (value - model) ** 2).sum(1)
    for _ in range(_STEPS):
        weighted = (jacobian * mask[..., None]).swapaxes(1, 2)
        gradient = (weighted @ (value - model)[..., None])[..., 0]
        hessian = weighted @ jacobian
        diagonal = np.einsum("npp->np", hessian)
        damped = hessian + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(9)
        step = np.clip(np.linalg.solve(damped, gradient[..., None])[..., 0], -0.5, 0.5)
        tried = p + step
        model_tried, jacobian_tried = _edges(tried, x)
        cost_tried = (mask * (value - model_tried) ** 2).sum(1)
        better = cost_tried < cost
        damping = np.where(better, damping / 5, damping * 5)
        done = not better.any() or np.abs(step[better, :2]).max(initial=0.0) < 1e-5
        p, cost = np.where(better[:, None], tried, p), np.where(better, cost_tried, cost)
        model, jacobian = np.where(better[:, None], model_tried, model), np.where(better[:, None, None], jacobian_tried, jacobian)
        if done and damping.min(initial=1.0) < 1e3:
            break
    count = (mask > 0).sum(1)
    hessian = (jacobian * mask[..., None]).swapaxes(1, 2) @ jacobian + 1e-9 * np.eye(9)
    variance = np.einsum("npp->np", np.linalg.inv(hessian))[:, :2].mean(1) * cost / np.maximum(count - 9, 1)
    return p, variance, np.sqrt(cost / np.maximum(mask.sum(1), 1e-12))


def _edges(p: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The model at pixels (N, K, 2): (N, K), and its derivatives (N, K, 9)."""
    offset = x - p[:, None, :2]
    cos, sin = np.cos(p[:, 2:4]), np.sin(p[:, 2:4])
    normal = np.stack([cos, sin], -1)  # (N, 2, 2)
    tangent = np.stack([-sin, cos], -1)
    blur = np.exp(np.clip(p[:, 4], -3, 3))[:, None, None]
    distance = np.einsum("nkj,nej->nke", offset, normal) / blur
    edge, slope = erf(distance / np.sqrt(2)), np.sqrt(2 / np.pi) * np.exp(-0.5 * distance**2)
    b = p[:, None, 6]
    model = p[:, None, 5] + b * edge.prod(-1) + np.einsum("nkj,nj->nk", offset, p[:, 7:9])
    by_distance = b[..., None] * slope * edge[..., ::-1] / blur  # of each edge, per pixel
    by_crossing = -np.einsum("nke,nej->nkj", by_distance, normal) - p[:, None, 7:9]
    by_angle = by_distance * np.einsum("nkj,nej->nke", offset, tangent)
    by_blur = -(by_distance * distance * blur).sum(-1)
    one = np.ones_like(model)
    derivatives = [by_crossing, by_angle, by_blur[..., None], one[..., None], edge.prod(-1)[..., None], offset]
    return model, np.concatenate(derivatives, -1)
