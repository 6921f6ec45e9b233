"""Space before the cameras that no picture tells of."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import Sampling, contract
from mmsynth.field.rendering import FREE, NEAR
from mmsynth.field.surface import Surface
from mmsynth.fitting.measurements import Modality
from mmsynth.fitting.unseen import solid_of, unseen_before_cameras
from mmsynth.scene.motion import motion_to_matrix
from mmsynth.sensors.camera import Camera, unproject

GRID = 64
nowhere = lambda points: np.zeros(len(points), bool)
NARROW = Camera(64, 48, 200.0, 200.0, 31.5, 23.5)


def _modality(cameras: list[Camera], poses: np.ndarray) -> Modality:
    rotations, origins = poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)
    return Modality(None, cameras, np.arange(len(cameras)), rotations, origins, [], np.arange(len(cameras)), 1, 1, 0, 0, False)  # type: ignore[arg-type]


def _looking_inwards(stands: list[list[float]]) -> np.ndarray:
    """Poses of cameras that look at the centre."""
    out = np.tile(np.eye(4), (len(stands), 1, 1))
    for pose, stand in zip(out, np.array(stands), strict=True):
        z = -stand / np.linalg.norm(stand)
        x = np.cross([0.3, 0.8, 0.5], z)
        x /= np.linalg.norm(x)
        pose[:3] = np.stack([x, np.cross(z, x), z, stand], 1)
    return out


def _cell(points: np.ndarray) -> tuple[np.ndarray, ...]:
    where = contract(torch.from_numpy(points)).numpy()
    return tuple(((where + 2.0) * (GRID / 4.0)).astype(int).T)


def _along(stand: list[float], radii: float) -> tuple[np.ndarray, ...]:
    """The cell so many radii from the centre, in the direction of a camera."""
    return _cell(np.array([stand]) / np.linalg.norm(stand) * radii)


def test_cells_before_a_camera_are_unseen_unless_another_camera_sees_them() -> None:
    stands = [[0.0, 0.0, 3.0], [2.5, 0.0, -2.0]]
    alone = unseen_before_cameras([_modality([NARROW] * 2, _looking_inwards(stands))], GRID, nowhere)
    # rays of the first begin 1.6 before it, 1.4 from the centre
    assert alone[_along(stands[0], 2.0)].all() and alone[_along(stands[0], 1.7)].all()
    assert not alone[_along(stands[0], 1.2)].any() and not alone[_along([0.0, 1.0, 0.0], 2.0)].any()
    # a third looks past the centre at what is before the first
    aside = _looking_inwards([*stands, [0.0, 6.0, 0.0]])
    aside[2, :3, 3] += [0.0, 0.0, 2.0]
    wide = Camera(64, 48, 100.0, 100.0, 31.5, 23.5)
    seen = unseen_before_cameras([_modality([NARROW, NARROW, wide], aside)], GRID, nowhere)
    assert not seen[_along(stands[0], 2.0)].any() and seen[_along(stands[1], 2.2)].all()
    # but not if its rays begin in something solid, which is before them alone, or if they do on that side
    begin = FREE * (np.linalg.norm(aside[2, :3, 3]) - 1.0)
    before = lambda points: np.linalg.norm(points - aside[2, :3, 3], axis=1) < begin * 1.001
    pictures = _modality([NARROW, NARROW, wide], aside)
    painted = unseen_before_cameras([pictures], GRID, before)
    assert painted[alone].all() and not seen[alone].all() and (seen <= painted).all()
    half = unseen_before_cameras([pictures], GRID, lambda points: before(points) & (points[:, 2] > 1.8))
    assert (seen <= half).all() and (half <= painted).all() and (seen < half).any() and (half < painted).any()
    # by a sensor of its own, as well
    both = [_modality([NARROW] * 2, aside[:2]), _modality([wide], aside[2:])]
    assert np.array_equal(unseen_before_cameras(both, GRID, nowhere), seen)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 6), fisheye=st.booleans())
def test_no_ray_of_a_picture_passes_unseen_cells(seed: int, count: int, fisheye: bool) -> None:
    """But in a cell's width at the picture's border and where rays begin; and none of them is in the region."""
    random = np.random.default_rng(seed)
    poses = motion_to_matrix(np.concatenate([random.normal(size=(count, 3)), random.normal(size=(count, 3)) * 2.0], 1))
    lens: dict = dict(distortion=(0.02, -0.01, 0.0, 0.0), lens="kannala_brandt") if fisheye else dict(distortion=(-0.2, 0.05, 0.001, 0.0))
    camera = Camera(96, 72, 60.0, 60.0, 47.0, 36.0, **lens)
    unseen = unseen_before_cameras([_modality([camera] * count, poses)], GRID, nowhere)
    axis = np.abs((np.arange(GRID) + 0.5) * (4.0 / GRID) - 2.0)
    assert not unseen[np.ix_(axis < 0.55, axis < 0.55, axis < 0.55)].any()
    for pose in poses:
        pixels = random.uniform(0.0, [95.0, 71.0], (300, 2))
        local, valid = unproject(pixels, camera)
        begin = max(NEAR, FREE * (np.linalg.norm(pose[:3, 3]) - 1.0))
        distance = begin + 4.0 * random.random(300) ** 2
        points = pose[:3, 3] + (local @ pose[:3, :3].T) * distance[:, None]
        # twice the size of a cell where it is largest
        size = 4.0 * np.sqrt(3.0) * 2.0 / GRID * np.maximum(np.linalg.norm(points, axis=1), 1.0) ** 2
        border = np.minimum(pixels, [95.0, 71.0] - pixels).min(1)
        inside = valid & (distance - size > begin) & (border > 60.0 * size / distance)
        assert not unseen[_cell(points[inside])].any()


def test_many_cameras_in_one_place_are_as_one() -> None:
    """All cells that count as unseen lie before a camera: nearer than where its rays begin."""
    stand = [0.0, 0.0, 2.2]
    poses = np.repeat(_looking_inwards([stand]), 5, axis=0)
    unseen = unseen_before_cameras([_modality([NARROW] * 5, poses)], GRID, nowhere)
    assert np.array_equal(unseen, unseen_before_cameras([_modality([NARROW], poses[:1])], GRID, nowhere)) and unseen.any()
    cells = (np.argwhere(unseen) + 0.5) * (4.0 / GRID) - 2.0
    r = np.linalg.norm(cells, axis=1, keepdims=True)
    away = np.linalg.norm(cells / r / (2.0 - r) - stand, axis=1)
    assert (r > 1.0).all() and away.max() < FREE * 1.2 and away.max() == pytest.approx(FREE * 1.2, rel=0.05)


def test_a_field_is_solid_in_its_spheres() -> None:
    """Radius 0.5, and what is beyond 1.9 in contracted space: 10 radii."""
    torch.manual_seed(0)
    surface = Surface(HashGrid(2, 8, 4, 8, 2.0), 4, (0.5, 1.9))
    field = SimpleNamespace(surface=surface, sampling=Sampling(400.0, 0.005, 2, 2), device="cpu")
    random = np.random.default_rng(0)
    radius = np.geomspace(0.05, 50.0, 5000)
    aim = random.normal(size=(5000, 3))
    found = solid_of(field)(aim / np.linalg.norm(aim, axis=1, keepdims=True) * radius[:, None])  # type: ignore[arg-type]
    near = (np.abs(radius - 0.5) < 0.01) | (np.abs(radius - 10.0) < 0.5)
    assert np.array_equal(found[~near], ((radius < 0.5) | (radius > 10.0))[~near])
