"""Small scenes written to disk, in the formats that the readers know; one thread for each of the processes that share the tests."""

from __future__ import annotations

import worker  # noqa: F401

# isort: split
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few_looks import few_looks

from mmsynth.bench import machine
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera
from mmsynth.threads import kernel_threads, let_kernels_have

WIDTH, HEIGHT = 24, 18
sys.path.append(str(Path(__file__).parent / "field"))  # cases of the CPU's kernels are those of Triton's

# a script's background job begins with SIGINT ignored, and so would what tests interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def look_at(position: Iterable[float], target: Iterable[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """(4, 4) camera_to_world in OpenCV axes, z up in the world."""
    position, target = np.array(list(position), float), np.array(list(target), float)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(forward, right), forward, position])
    return pose


def ring(count: int, radius: float = 3.0, height: float = 1.0) -> list[np.ndarray]:
    """Poses on a ring, looking at the origin."""
    angles = 2 * np.pi * np.arange(count) / count
    return [look_at((radius * np.cos(a), radius * np.sin(a), height)) for a in angles]


def unpacked(views: Iterable[PosedCamera]) -> list[tuple[Camera, np.ndarray, str]]:
    return [(view.camera, view.camera_to_world, view.name) for view in views]


def frame_values(view: int, channels: int = 0) -> np.ndarray:
    """An image that differs in every view, row, column and channel."""
    shape = (HEIGHT, WIDTH, channels) if channels else (HEIGHT, WIDTH)
    return np.random.default_rng(view).random(shape).astype(np.float32)


@pytest.fixture
def write_mmsdata(tmp_path: Path) -> Callable[..., Path]:
    """Write an MMS-DATA scene (raw, rgb and infrared, Brown lens); ``edit(meta)`` may change meta_data.json before it is written."""

    def write(views: Iterable[int] = range(4), edit: Callable[[dict[str, Any]], None] | None = None) -> Path:
        views = list(views)
        root = tmp_path / "scene"
        modalities = {}
        for name, pattern in (("rgb", [[1, 2], [0, 1]]), ("infrared", [[0]])):
            frames = []
            for view, pose in zip(views, ring(len(views)), strict=True):
                write_png16(root / "modalities" / name / f"{view:04d}.png", frame_values(view))
                frames.append({"frame_id": view, "file_name": f"{view:04d}.png", "camtoworld": (pose @ OPENCV_TO_OPENGL)[:3].tolist()})
            modalities[name] = {
                "camera_model": "OPENCV", "width": WIDTH, "height": HEIGHT, "fx": 25.0, "fy": 26.0, "cx": 11.7, "cy": 8.4,
                "distortion_params": [-0.12, 0.09, 0.01, -0.02, 0.003, 0.0], "mosaick_pattern": pattern, "frames": frames,
            }  # fmt: skip
        meta: dict[str, Any] = {
            "undistorted": False, "raw": True, "pixel_offset": 0.0,
            "scene_box": {"collider_type": "sphere", "radius": 1.0, "aabb": [[-1, -1, -1], [1, 1, 1]]},
            "worldtogt": [[0.0, -0.25, 0.0, 0.1], [0.25, 0.0, 0.0, 0.2], [0.0, 0.0, 0.25, 0.3], [0.0, 0.0, 0.0, 1.0]],
            "modalities": modalities,
        }  # fmt: skip
        if edit is not None:
            edit(meta)
        (root / "meta_data.json").write_text(json.dumps(meta))
        return root

    return write


@pytest.fixture
def write_transforms(tmp_path: Path) -> Callable[..., Path]:
    """Write a nerfstudio scene of 16-bit RGB images; ``edit(meta)`` may change transforms.json before it is written."""

    def write(count: int = 4, channels: int = 3, edit: Callable[[dict[str, Any]], None] | None = None) -> Path:
        root = tmp_path / "scene"
        frames = []
        for view, pose in enumerate(ring(count)):
            write_png16(root / "images" / f"{view:04d}.png", frame_values(view, channels))
            frames.append({"file_path": f"images/{view:04d}.png", "transform_matrix": (pose @ OPENCV_TO_OPENGL).tolist()})
        meta: dict[str, Any] = {
            "fl_x": 25.0, "fl_y": 26.0, "cx": 12.2, "cy": 8.9, "w": float(WIDTH), "h": float(HEIGHT),
            "k1": -0.12, "k2": 0.09, "p1": 0.01, "p2": -0.02, "frames": frames,
        }  # fmt: skip
        if edit is not None:
            edit(meta)
        (root / "transforms.json").write_text(json.dumps(meta))
        return root

    return write


@pytest.fixture(autouse=True, scope="session")
def _machines_measured_briefly() -> None:
    """Once instead of the best of five, for the many reports of tests; the tests of tables do not read these numbers."""
    machine._REPEATS = 1


@pytest.fixture
def decided_by_few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a fit in a test of something else."""
    few_looks(monkeypatch)


@pytest.fixture
def use_threads() -> Iterator[Callable[[int], None]]:
    """Give so many threads to kernels that the test calls."""
    before = kernel_threads()
    yield let_kernels_have
    let_kernels_have(before)


# --- the table of hard cases: pytest tests/hard_cases --hard-cases FILE

_ROWS = pytest.StashKey[list[tuple[str, str, str, str]]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--hard-cases", metavar="FILE", help="write the table of hard cases")


@pytest.fixture
def row(request: pytest.FixtureRequest) -> Callable[[str, str, str], None]:
    """row(case, usual, ours): a line of the table."""
    rows = request.config.stash.setdefault(_ROWS, [])
    test = f"{Path(request.node.path).stem.removeprefix('test_')}: {request.node.originalname.removeprefix('test_').replace('_', ' ')}"
    return lambda case, usual, ours: rows.append((case, usual, ours, test))


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    target = session.config.getoption("--hard-cases", None)
    if not target or exitstatus != 0:
        return
    lines = ["| case | the usual formula | ours | test |", "|:--|:--|:--|:--|"]
    lines += [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |" for cells in session.config.stash.get(_ROWS, [])]
    head = "# Hard cases\n\nMade by `pytest tests/hard_cases --hard-cases tests/hard_cases/README.md`: what the tests measured.\n\n"
    Path(target).write_text(head + "\n".join(lines) + "\n", encoding="utf-8")


INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"

if INTERPRETED:
    import quick_interpreter  # noqa: F401


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of the tests of Triton, those with a ``device`` need a GPU or the interpreter; the others have nothing to do with the interpreter.

    Slow tests come first: at the end one process would wait for another's. Of these the viewer's are the first, which compile kernels;
    tests that need none come in the middle, where the second of two processes begins: so one of the two compiles.
    """
    items.sort(key=lambda item: (item.get_closest_marker("slow") is None, not item.nodeid.startswith("tests/viewer/")))
    need_none = ("tests/scene/", "tests/sensors/")
    others = [item for item in items if not item.nodeid.startswith(need_none)]
    middle = len(items) // 2
    items[:] = [*others[:middle], *(item for item in items if item.nodeid.startswith(need_none)), *others[middle:]]
    no_gpu = pytest.mark.skip(reason="needs a CUDA device")
    for item in items:
        if "field/cuda" not in item.path.as_posix():
            continue
        if "device" not in getattr(item, "fixturenames", ()):
            if INTERPRETED:
                item.add_marker(pytest.mark.skip(reason="has nothing to do with the interpreter"))
        elif not INTERPRETED:
            item.add_marker(pytest.mark.gpu)
            if not torch.cuda.is_available():
                item.add_marker(no_gpu)


@pytest.fixture
def device() -> str:
    """Of the tests of Triton: a GPU where there is one, CPU tensors in Triton's interpreter.

    Whether Triton compiles or interprets is decided when it is first imported. So the interpreter gets a process of its own (see
    tests/field/cuda/test_cuda_availability.py), where these tests run a second time, with TRITON_INTERPRET=1.
    """
    torch.manual_seed(0)
    return "cpu" if INTERPRETED else "cuda"
