"""The sensor models against real captures: python recipes/bench/captures.py board FOLDER, or: closure FILES.

``board``: chessboard pictures (OpenCV's samples: 9 x 6 corners). The camera is calibrated by OpenCV, and again through the gradients
of ``mmsynth.sensors.camera``; both start from the same guess and are compared, and so are their projections.
``closure``: raw frames of a polarization sensor. Of linear frames I0 + I90 = I45 + I135; what is left is noise, or a wrong order or gamma.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import typer
from scipy.optimize import least_squares

from mmsynth.sensors.camera import project_points
from mmsynth.sensors.mosaic import channel_map
from mmsynth.sensors.polarization import closure as closure_of
from mmsynth.sensors.polarization import degree_of_linear_polarization, intensities_to_stokes

app = typer.Typer(no_args_is_help=True, add_completion=False)


@app.command()
def board(folder: Path, glob: str = "left[0-9][0-9].jpg", columns: int = 9, rows: int = 6, square: float = 0.025) -> None:
    """Calibrate from chessboard pictures, by OpenCV and through our gradients."""
    grid = np.zeros((columns * rows, 3))
    grid[:, :2] = square * np.mgrid[:columns, :rows].T.reshape(-1, 2)
    corners, size = [], (0, 0)
    for path in sorted(folder.glob(glob)):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        size = picture.shape[::-1]
        found, points = cv2.findChessboardCorners(picture, (columns, rows))
        if found:
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
            corners.append(cv2.cornerSubPix(picture, points, (5, 5), (-1, -1), criteria).reshape(-1, 2).astype(np.float64))
    boards = [grid.astype(np.float32)] * len(corners)
    began = time.perf_counter()
    rms, matrix, k, rotations, translations = cv2.calibrateCamera(boards, [c.astype(np.float32) for c in corners], size, None, None)
    by_opencv = time.perf_counter() - began
    print(
        f"{len(corners)} boards; OpenCV: rms {rms:.4f} px, f {np.diag(matrix)[:2].round(2)}, k {k.ravel()[:5].round(4)}, {by_opencv:.2f} s"
    )

    # their calibration, our projection
    worst = 0.0
    for r, t in zip(rotations, translations, strict=True):
        theirs = cv2.projectPoints(grid, r, t, matrix, k)[0].reshape(-1, 2)
        ours = _project(
            torch.from_numpy(np.r_[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], k.ravel()[:5], r.ravel(), t.ravel()]), grid
        )
        worst = max(worst, float((ours - torch.from_numpy(theirs)).abs().max()))
    print(f"projections of the {len(corners) * len(grid)} corners: at most {worst:.1e} px from OpenCV's")

    # our gradients, from a pinhole of a rough focal length and the poses that it gives
    focal = float(max(size))
    start = [focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, *[0.0] * 5]
    pinhole = np.array([[focal, 0, start[2]], [0, focal, start[3]], [0, 0, 1]])
    for c in corners:
        _, r, t = cv2.solvePnP(grid, c, pinhole, None)
        start += [*r.ravel(), *t.ravel()]
    target = torch.from_numpy(np.stack(corners))

    def residuals(x: torch.Tensor) -> torch.Tensor:
        poses = x[9:].reshape(-1, 6)
        return torch.stack([_project(torch.cat([x[:9], p]), grid) for p in poses]).sub(target).reshape(-1)

    began = time.perf_counter()
    jacobian = torch.func.jacfwd(residuals)
    found = least_squares(
        lambda x: residuals(torch.from_numpy(x)).numpy(), np.array(start), lambda x: jacobian(torch.from_numpy(x)).numpy(), x_scale="jac"
    )
    ours = np.sqrt(2 * found.cost / (target.numel() / 2))
    taken = time.perf_counter() - began
    print(f"mmsynth's gradients: rms {ours:.4f} px, f {found.x[:2].round(2)}, k {found.x[4:9].round(4)}, {taken:.2f} s")


def _project(camera: torch.Tensor, points: np.ndarray) -> torch.Tensor:
    """fx, fy, cx, cy, k1, k2, p1, p2, k3, rotation vector, translation: (15,) → pixels (N, 2)."""
    turn = camera[9:12]
    skew = torch.stack([torch.linalg.cross(turn, axis) for axis in torch.eye(3, dtype=torch.float64)], 1)
    local = torch.from_numpy(points) @ torch.linalg.matrix_exp(skew).T + camera[12:15]
    return project_points(local, camera[:4], torch.cat([camera[4:9], torch.zeros(3, dtype=torch.float64)]))[0]


@app.command()
def closure(
    files: list[Path],
    pattern: Annotated[str, typer.Option(help="angles at (0, 0), (0, 1), (1, 0), (1, 1)")] = "90,45,135,0",
    gamma: Annotated[float, typer.Option(help="of the files")] = 1.0,
) -> None:
    """What of raw frames no Stokes vector explains, on superpixels without a clipped or black photosite."""
    angles = [float(a) for a in pattern.split(",")]
    for path in files:
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        full = float(np.iinfo(raw.dtype).max)
        height, width = (n // 2 * 2 for n in raw.shape)
        index = channel_map(np.array([[0, 1], [2, 3]]), height, width)
        four = np.stack([raw[:height, :width][index == i].reshape(height // 2, width // 2) for i in range(4)], -1) / full
        usable = (four.max(-1) < 0.98) & (four.min(-1) > 0.02)
        intensities = torch.from_numpy(four[usable] ** gamma)
        stokes = intensities_to_stokes(intensities, angles)
        left = closure_of(intensities, angles)[:, 0] / stokes[:, 0]
        degree = degree_of_linear_polarization(stokes)
        mean, rms = float(left.mean()), float(left.square().mean().sqrt())
        above = float((degree > 1).double().mean())
        print(f"{path.name}: {usable.mean():.1%} of the superpixels; closure / S0: mean {mean:+.4f}, rms {rms:.4f}; ", end="")
        print(f"DoLP: median {float(degree.median()):.3f}, above 1: {above:.2%}")


if __name__ == "__main__":
    app()
