"""Corners of squares refined on the photosites: a model of two crossing edges fitted to the pixels around each corner.

With t and u the distances of a point from the two edges over σ, the blur of the lens, and Φ the normal distribution,

    I = mean over the photosite of  a + g·x + b (2Φ(t) - 1)(2Φ(u) - 1),

less 2b Φ(t - c) Φ(u - d) where a marker's black border begins at distances c and d from the edges of its white square. Nine parameters
by Levenberg-Marquardt in float64, all corners at once: the crossing (2), the directions of the edges (2), log σ, a, b and g (2). The
pattern around a corner looks the same when turned by half, as does a tone curve's effect on it, so neither a blur nor a gamma moves the
corner. Small squares need all of it: with edges at the pixels' centres, and without the white beside a marker, corners of boards that
were drawn without noise (squares of 9 to 13 pixels) were off by 0.02 to 0.03 px, and by 0.007 with them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

_WINDOW = 12  # pixels from the corner at the most: edges are straight there
_REACH = 0.42  # of a square
_CLEAR = 1.5  # pixels by which the inside of a marker blurs into its black border
_BLUR = (-2.0, 1.5)  # logarithms of σ [px]
_WITHIN = [(i / 3, j / 3) for i in (-1, 0, 1) for j in (-1, 0, 1)]  # places within a photosite, whose light it gathers
_STEPS, _REST = 25, 1e-4  # of Gauss and Newton; px that a corner moves at the last of them
_MISFIT = 0.3  # rms of what is not explained, relative to half the contrast of black and white
_AWAY = 0.3  # of a square's shortest side [px] by which a corner may move, or two pixels


def refine_saddles(
    picture: np.ndarray, weight: np.ndarray, pixels: np.ndarray, across: np.ndarray, marker: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners to a few hundredths of a pixel.

    Args:
        picture: (H, W) float, channels at one level; weight: (H, W) ≥ 0, of its pixels.
        pixels: (N, 2) where corners are, to a pixel or two; across: (N, 2, 2) pixels for one square to the right and one down, in columns.
        marker: of those in the white squares, how far from the edges [squares] their black border begins and ends; None: there are none.
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
    begin, end = marker or (np.inf, np.inf)
    margin = end - _CLEAR / side
    plain = (sign != white[:, None]) | (np.abs(board).min(-1) < margin[:, None])
    mask = grain * (near & plain)

    normal = np.linalg.inv(across)  # rows: normals of the two edges
    angle = np.arctan2(normal[:, :, 1], normal[:, :, 0])
    scale = np.maximum(np.abs(pair[0] - pair[1]) / 2, 1e-9)
    value = (value - ((pair[0] + pair[1]) / 2)[:, None]) / scale[:, None]
    parameters = np.concatenate([pixels, angle, np.full((len(pixels), 1), np.log(0.6)), np.zeros((len(pixels), 4))], 1)
    parameters[:, 6] = white
    clear = begin / np.linalg.norm(normal, axis=2) if marker else None  # (N, 2) px
    parameters, covariance, residual = _gauss_newton(parameters, x, value, mask, clear)

    moved = np.linalg.norm(parameters[:, :2] - pixels, axis=1)
    good = (moved < np.maximum(2.0, _AWAY * side)) & (parameters[:, 6] * white > 0.3) & (residual < _MISFIT * np.abs(parameters[:, 6]))
    good &= ~flat & ((mask > 0).sum(1) > 14) & (parameters[:, 4] < _BLUR[1])
    turned = np.sin(parameters[:, 3] - parameters[:, 2]) / np.sin(angle[:, 1] - angle[:, 0])
    good &= np.isfinite(moved) & (turned > 0.3)
    return np.where(good[:, None], parameters[:, :2], np.nan), np.sqrt(np.maximum(covariance, 0.0)), white


def _gauss_newton(
    p: np.ndarray, x: np.ndarray, value: np.ndarray, mask: np.ndarray, clear: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (N, 9), mean variance of the crossing's coordinates (N,), rms of the residual in units of the contrast (N,)."""
    # the pixels that count, first of all
    most = max(int((mask > 0).sum(1).max(initial=0)), 1)
    order = np.argsort(mask <= 0, axis=1, kind="stable")[:, :most]
    x, value, mask = x[np.arange(len(x))[:, None], order], np.take_along_axis(value, order, 1), np.take_along_axis(mask, order, 1)
    p = p.copy()
    damping = np.full(len(p), 1e-3)
    model, jacobian = _edges(p, x, clear)
    cost = (mask * (value - model) ** 2).sum(1)
    active = np.arange(len(p))
    for _ in range(_STEPS):
        own = jacobian[active]
        weighted = (own * mask[active][..., None]).swapaxes(1, 2)
        gradient = (weighted @ (value[active] - model[active])[..., None])[..., 0]
        hessian = weighted @ own
        diagonal = np.einsum("npp->np", hessian)
        damped = hessian + (damping[active][:, None] * diagonal + 1e-9)[:, :, None] * np.eye(9)
        step = np.clip(np.linalg.solve(damped, gradient[..., None])[..., 0], -0.5, 0.5)
        tried = p[active] + step
        tried[:, 4] = np.clip(tried[:, 4], *_BLUR)
        model_tried, jacobian_tried = _edges(tried, x[active], None if clear is None else clear[active])
        cost_tried = (mask[active] * (value[active] - model_tried) ** 2).sum(1)
        better = cost_tried < cost[active]
        damping[active] = np.where(better, damping[active] / 5, damping[active] * 5)
        to = active[better]
        p[to], cost[to], model[to], jacobian[to] = tried[better], cost_tried[better], model_tried[better], jacobian_tried[better]
        rests = (better & (np.abs(step[:, :2]).max(1) < _REST)) | (damping[active] > 1e3)
        active = active[~rests]
        if not len(active):
            break
    count = (mask > 0).sum(1)
    hessian = (jacobian * mask[..., None]).swapaxes(1, 2) @ jacobian + 1e-9 * np.eye(9)
    variance = np.einsum("npp->np", np.linalg.inv(hessian))[:, :2].mean(1) * cost / np.maximum(count - 9, 1)
    return p, variance, np.sqrt(cost / np.maximum(mask.sum(1), 1e-12))


def _edges(p: np.ndarray, x: np.ndarray, clear: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The model at pixels (N, K, 2): (N, K), and its derivatives (N, K, 9)."""
    cos, sin = ((f(p[:, 2, None]), f(p[:, 3, None])) for f in (np.cos, np.sin))  # (N, 1), of each edge's normal
    blur, sign = np.exp(p[:, 4, None]), np.sign(p[:, 6, None])
    right, down = x[..., 0] - p[:, 0, None], x[..., 1] - p[:, 1, None]
    across, along = ([c * u + s * v for c, s in zip(cos, sin, strict=True)] for u, v in ((right, down), (down, -right)))
    shape, by_log = np.zeros(right.shape), np.zeros(right.shape)
    by_distance, by_angle = ([np.zeros(right.shape), np.zeros(right.shape)] for _ in range(2))
    for u, v in _WITHIN:
        distance = [a + (c * u + s * v) for a, c, s in zip(across, cos, sin, strict=True)]
        value, slopes, stretch = _pattern(distance, blur, sign, clear)
        shape += value
        by_log += stretch
        for edge in range(2):
            by_distance[edge] += slopes[edge]
            by_angle[edge] += slopes[edge] * (along[edge] + (cos[edge] * v - sin[edge] * u))
    shape /= len(_WITHIN)
    b, tilt, each = p[:, 6, None], p[:, 7:9, None], p[:, 6, None] / len(_WITHIN)
    model = p[:, 5, None] + b * shape + (right * tilt[:, 0] + down * tilt[:, 1])
    by_crossing = [-each * (n[0] * by_distance[0] + n[1] * by_distance[1]) - tilt[:, i] for i, n in enumerate((cos, sin))]
    derivatives = [*by_crossing, each * by_angle[0], each * by_angle[1], each * by_log, np.ones_like(model), shape, right, down]
    return model, np.stack(derivatives, -1)


def _pattern(
    distance: Sequence[np.ndarray], blur: np.ndarray, sign: np.ndarray, clear: np.ndarray | None
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """1 on squares of one colour, -1 on those of the other and on the markers' borders, blurred.

    Args:
        distance: (N, K) from each of the two edges. blur: (N, 1). sign: (N, 1) 1 where both distances have one sign on white squares,
            else -1. clear: (N, 2) from an edge to the border beside it; None: no markers.
    Returns:
        (N, K), its derivatives by the two distances (N, K) and by log σ (N, K).
    """
    t, s = distance[0] / blur, distance[1] / blur
    u, v = 2 * ndtr(t) - 1, 2 * ndtr(s) - 1
    value, by_t, by_s = u * v, 2 * _bell(t) * v, 2 * u * _bell(s)
    by_log = -(by_t * t + by_s * s)
    if clear is not None:
        c = clear / blur
        for way in (1.0, -1.0):  # two squares are white
            p, q = way * t - c[:, :1], way * sign * s - c[:, 1:]
            right, down = ndtr(p), ndtr(q)
            by_p, by_q = -2 * sign * _bell(p) * down, -2 * sign * right * _bell(q)
            value = value - 2 * sign * right * down
            by_t, by_s = by_t + way * by_p, by_s + way * sign * by_q
            by_log = by_log - (by_p * p + by_q * q)
    return value, [by_t / blur, by_s / blur], by_log


def _bell(t: np.ndarray) -> np.ndarray:
    return np.asarray(np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi))
