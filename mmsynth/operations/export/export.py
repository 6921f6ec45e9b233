"""Write a scene in a layout of other tools: pictures byte for byte, poses as a fit corrected them."""

from __future__ import annotations

import functools
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_atomic
from mmsynth.operations.export.plans import ExportLayout, Plan, plan_of
from mmsynth.operations.output.progress import Progress
from mmsynth.scene.checks import rigid_pose
from mmsynth.scene.image_writers import write_png
from mmsynth.scene.images import check_file, read_native
from mmsynth.scene.load import sparse_points
from mmsynth.scene.scene import Scene

if TYPE_CHECKING:
    from mmsynth.field.field import Field


@dataclass(frozen=True)
class Exported:
    """What was written: the folder, how many frames of each sensor, masks and sparse points, and sentences on what did not fit."""

    path: Path
    layout: str
    frames: dict[str, int]
    masks: int
    points: int
    notes: tuple[str, ...]

    def facts(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {
            "out": str(self.path), "layout": self.layout, "frames": self.frames, "masks": self.masks, "points": self.points,
            "notes": list(self.notes),
        }  # fmt: skip


def export_scene(
    scene: Scene, out: Path | str, *, layout: ExportLayout, field: Field | None = None, progress: Progress | None = None
) -> Exported:
    """Write a scene in another layout.

    Pictures and masks are copied byte for byte (a mask that must be a PNG file and is not, is encoded anew), test views stay test views,
    sparse points go along. The file by which a layout is recognised comes last: without it nothing was finished.

    Args:
        out: a folder, made where it is missing. field: learned from the scene; its corrections of poses are applied.
        progress: called with the number of files done, and of all.
    Raises:
        InputError: unknown layout, a scene that it does not hold, a missing or damaged picture, or a folder that holds the scene itself.
    """
    out = Path(out)
    poses = {
        i: rigid_pose(frame.camera_to_world if field is None else field.pose_of(frame), f"{frame.path}: its pose")
        for i, frame in enumerate(scene.frames)
    }
    points = sparse_points(scene)
    plan = plan_of(scene, poses, points, layout)
    _check(plan, out)
    for name in plan.index:
        (out / name).unlink(missing_ok=True)  # it must not vouch for what is being replaced
    copies = {**plan.pictures, **plan.masks}
    for done, (name, source) in enumerate(copies.items(), 1):
        _copy(source, out / name)
        if progress is not None:
            progress(done, len(copies))
    for name, content in plan.index.items():
        write_atomic(out / name, functools.partial(Path.write_bytes, data=content))
    frames = {name: len(scene.frames_of(name)) for name in scene.sensors}
    moved = [] if field is None else _moved(scene, poses)
    return Exported(out, layout, frames, len(plan.masks), 0 if points is None else len(points.positions), (*moved, *plan.notes))


def _check(plan: Plan, out: Path) -> None:
    """Every source is whole, and none of them is what would be replaced."""
    sources = {path.resolve() for path in (*plan.pictures.values(), *plan.masks.values())}
    for name in (*plan.pictures, *plan.masks):
        if (out / name).resolve() in sources:
            raise InputError(f"{out}: holds the scene's own {name}, expected another folder.")
    for path in sources:
        check_file(path)


def _copy(source: Path, target: Path) -> None:
    if target.suffix == source.suffix.lower():
        write_atomic(target, lambda temporary: shutil.copyfile(source, temporary))
    else:
        write_png(target, read_native(source))


def _moved(scene: Scene, poses: dict[int, np.ndarray]) -> list[str]:
    """How far the fit moved the cameras."""
    apart = [float(np.linalg.norm(poses[i][:3, 3] - frame.camera_to_world[:3, 3])) for i, frame in enumerate(scene.frames)]
    turned = [_angle(poses[i], frame.camera_to_world) for i, frame in enumerate(scene.frames)]
    if max(apart) < 1e-12 and max(turned) < 1e-9:
        return ["the fit left the poses as they were."]
    return [
        f"the fit moved the cameras by {np.median(apart):.3g} {scene.unit} and {np.median(turned):.3g} degrees (medians; at the most "
        f"{max(apart):.3g} and {max(turned):.3g})."
    ]


def _angle(one: np.ndarray, two: np.ndarray) -> float:
    """Between two orientations, in degrees; by the chord, which keeps its digits where they are almost the same."""
    chord = np.linalg.norm(one[:3, :3] - two[:3, :3]) / np.sqrt(8.0)
    return float(np.degrees(2 * np.arcsin(min(1.0, float(chord)))))
