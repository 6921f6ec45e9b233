"""A capture without poses into a scene, with its report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mmsynth.report.pose import write_pose_report
from mmsynth.scene.capture.board import read_boards
from mmsynth.scene.capture.pose import PosedCapture, Progress, pose_capture, write_posed
from mmsynth.scene.capture.source import read_capture


def pose_scene(
    capture: Path,
    out: Path | None = None,
    *,
    calibration: Path | None = None,
    board: Path | None = None,
    reference: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Find the poses of a capture and write the scene, COLMAP's model and ``report.html``.

    Args:
        out: the scene's folder; None: ``NAME_scene`` here. board: ``board.toml`` of boards that stand in the scene.
        The others: see ``read_capture`` and ``pose_capture``.
    Returns:
        what ``pose_facts`` says of it, and scene, the folder, and seconds.
    Raises:
        InputError: as these two and ``write_posed``.
    """
    start = time.perf_counter()
    found = read_capture(capture, calibration, reference)
    folder = out or Path(f"{found.root.resolve().name}_scene")
    posed = pose_capture(found, () if board is None else read_boards(board), progress=progress)
    write_posed(posed, folder)
    facts = pose_facts(posed) | {"scene": str(folder), "seconds": time.perf_counter() - start}
    write_pose_report(folder / "report.html", posed, facts)
    return facts


def pose_facts(posed: PosedCapture) -> dict[str, Any]:
    """Counts and errors as JSON holds them.

    Returns:
        pictures, registered, points, unit, unit_from, notes, left_out [{sensor, view, why}], rig_moved (by sensor length, degrees) and
        sensors: by name pictures, registered, points (mean of a picture), error_px (rms) and camera (None: several).
    """
    sensors = {}
    for captured in posed.capture.sensors:
        own = [r for (name, _), r in posed.structure.registered.items() if name == captured.sensor.name]
        cameras = {r.camera for r in own}
        camera = None
        if len(cameras) == 1:
            (one,) = cameras
            camera = {"fx": one.fx, "fy": one.fy, "cx": one.cx, "cy": one.cy} | {f"k{i}": v for i, v in enumerate(one.distortion)}
        weights = [r.points for r in own]
        error = float(np.sqrt(np.average([r.error**2 for r in own], weights=weights))) if sum(weights) else 0.0
        sensors[captured.sensor.name] = {
            "pictures": len(captured.files),
            "registered": len(own),
            "points": float(np.mean(weights)) if own else 0.0,
            "error_px": error,
            "camera": camera,
        }
    return {
        "pictures": sum(s["pictures"] for s in sensors.values()),
        "registered": len(posed.structure.registered),
        "points": len(posed.structure.points),
        "unit": posed.unit,
        "unit_from": posed.unit_from,
        "notes": list(posed.notes),
        "left_out": [{"sensor": sensor, "view": view, "why": why} for (sensor, view), why in posed.lost.items()],
        "rig_moved": _rig_moved(posed),
        "sensors": sensors,
    }


def _rig_moved(posed: PosedCapture) -> dict[str, dict[str, float]]:
    """How far sensors are from their calibrated places on the rig: metres and degrees; those that stayed are left out."""
    out = {}
    for captured in posed.capture.sensors:
        place = posed.structure.places.get(captured.sensor.name)
        if place is None or captured.camera_to_reference is None:
            continue
        motion = np.linalg.inv(captured.camera_to_reference) @ place
        length, degrees = float(np.linalg.norm(motion[:3, 3])), float(np.degrees(np.linalg.norm(cv2.Rodrigues(motion[:3, :3])[0])))
        if length > 1e-9 or degrees > 1e-7:
            out[captured.sensor.name] = {"length": length, "degrees": degrees}
    return out
