"""Pages of calibrations, poses, datasets, conversions and benches: the same frame, and what each is about."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import AnalyticField, ring_pose, scene_of, sphere
from drawn_rig import BOARD, board_poses, five_sensors, seen_corners
from page_reader import check

from mmsynth.bench.machine import measure
from mmsynth.bench.output import new_figure, write_report
from mmsynth.bench.tables import Column, Table
from mmsynth.operations.conversion.files import convert_files
from mmsynth.operations.dataset.generate import generate_dataset
from mmsynth.operations.dataset.index import verify_dataset
from mmsynth.operations.dataset.plan import DATASET_FORMATS
from mmsynth.report.calibration import write_calibration_report
from mmsynth.report.conversion import source_previews, write_conversion_report
from mmsynth.report.dataset import write_dataset_report
from mmsynth.report.pose import write_pose_report
from mmsynth.scene.capture.calibrate import calibrate_found
from mmsynth.scene.capture.pose import PosedCapture
from mmsynth.scene.capture.source import Capture, CapturedSensor
from mmsynth.scene.capture.structure import Registered, Structure
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.scene import PosedCamera, Region, Sensor
from mmsynth.sensors.camera import Camera
from mmsynth.workflows.pose import pose_facts


def test_calibration(tmp_path: Path) -> None:
    rig = {name: sensor for name, sensor in five_sensors().items() if name in ("rgb", "mono")}
    calibration = calibrate_found(seen_corners(rig, dict.fromkeys(rig, board_poses(8)), noise=0.05), [BOARD], "boards")
    (tmp_path / "rig.json").write_text("{}")
    write_calibration_report(tmp_path / "report.html", calibration, [("rig.json", "the rig"), ("gone.json", "nothing")])
    page = check(tmp_path / "report.html")
    assert [row[0] for row in page.table("Sensors")] == ["sensor", *calibration.rig]
    assert len(page.root.all("figure", class_="drawing")) == 3
    assert [a.attributes["href"] for a in page.root.all("ul", class_="files")[0].all("a")] == ["rig.json"]


def test_poses(tmp_path: Path) -> None:
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0)
    registered = {("rgb", i): Registered(camera, ring_pose(i, 5), 100, 0.5) for i in range(4)}
    structure = Structure(registered, {}, np.random.default_rng(0).normal(size=(50, 3)), np.ones(50))
    sensor = Sensor("rgb", ("R", "G", "B"), (None, None, None))
    capture = Capture(tmp_path / "capture", (CapturedSensor(sensor, "rgb", {i: tmp_path / f"{i}.png" for i in range(5)}),))
    posed = PosedCapture(capture, structure, Region((0.0, 0.0, 0.0), 1.0), "m", "the <rig>", {("rgb", 4): "no texture"}, ("A note.",))
    (tmp_path / "meta_data.json").write_text("{}")
    write_pose_report(tmp_path / "report.html", posed, pose_facts(posed))
    page = check(tmp_path / "report.html")
    assert page.table("Left out") == [["sensor", "view", "why"], ["rgb", "4", "no texture"]]
    assert page.table("Cameras")[1] == ["rgb", "fx", "50"] and "&lt;rig&gt;" in page.source


@pytest.mark.parametrize("rig", ["aligned", "native"])
@pytest.mark.parametrize("file_format", DATASET_FORMATS)
def test_a_dataset_has_its_page_and_stays_as_it_is(tmp_path: Path, rig: Any, file_format: Any) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", truth=False)
    views = [PosedCamera(field.cameras["rgb"], ring_pose(i, 7), f"pose <{i}>") for i in range(3)]
    how: dict[str, Any] = {"rig": rig, "file_format": file_format, "scene": scene}
    generate_dataset(field, views, tmp_path / "out", **how)  # type: ignore[arg-type]
    before = {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    path = write_dataset_report(tmp_path / "out")
    first = path.read_bytes()
    page = check(path)
    sections = page.root.all("section", class_="modality")
    assert len(sections) == 3 and "Coverage score" in sections[0].whole_text()
    maps = 8 if rig == "native" else 2  # depth and coverage, of every modality or of all
    assert all(len(section.all("figure", class_="picture")) == 4 + maps for section in sections)
    rows = page.table("all views")
    assert [row[:3] for row in rows[1:]] == [[f"{i:04d}", f"pose <{i}>", "24x18"] for i in range(3)]
    # another run finds everything made, and the page vouches for nothing
    times = lambda: {p: p.stat().st_mtime_ns for p in (tmp_path / "out").glob("*/**/*") if p.is_file()}
    made = times()
    generate_dataset(field, views, tmp_path / "out", **how)  # type: ignore[arg-type]
    assert verify_dataset(tmp_path / "out") == [] and write_dataset_report(tmp_path / "out").read_bytes() == first
    assert times() == made and made
    assert {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file() and p != path} == before


def test_a_long_dataset_shows_some_of_its_views(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    views = [PosedCamera(field.cameras["rgb"], ring_pose(i, 40), f"{i}") for i in range(40)]
    generate_dataset(field, views, tmp_path, modalities=["mono"], outputs=[])  # type: ignore[arg-type]
    page = check(write_dataset_report(tmp_path))
    titles = [section.all("h3")[0].text for section in page.root.all("section", class_="modality")]
    assert len(titles) == 24 and titles[0] == "view 0000" and titles[-1] == "view 0039" and len(page.table("all views")) == 41


@pytest.mark.parametrize(("target", "as_sensor"), [("pol", False), ("ms", False), ("ms", True)])
def test_conversion(tmp_path: Path, target: str, as_sensor: bool) -> None:
    field = AnalyticField(sphere())
    field.cameras["ms"] = Camera(20, 16, 22.0, 22.0, 9.5, 7.5)
    scene = scene_of(field, tmp_path / "scene", truth=False)
    written = convert_files(field, scene, tmp_path / "out", source="rgb", target=target, method="ratio", as_sensor=as_sensor)  # type: ignore[arg-type]
    sensor = field.sensors["rgb"]
    sidecars = [path for path in written if path.suffix == ".json"]
    page = check(write_conversion_report(tmp_path / "out", sidecars, sensor, source_previews(scene, sensor)))
    sections = page.root.all("section", class_="modality")
    assert len(sections) == 4
    for section in sections:
        # where the target's own pixels are others than the frame's, there is nothing to wipe
        assert len(section.all("figure", class_="wipe")) == (0 if as_sensor else 1)
        assert len(section.all("img", **{"alt": f"confidence of {target}, frame 0000"})) == (section is sections[0])
    table = page.table("weights of the methods for every frame")
    assert table[0][:2] == ["frame", "ratio"] and [row[:2] for row in table[1:]] == [[f"{i:04d}", "1.000"] for i in range(4)]
    assert [a.attributes["href"] for a in page.root.all("a") if "0002" in a.attributes["href"]] == [
        f"{target}/0002.npz", f"{target}/0002.json"
    ]  # fmt: skip


def test_conversion_of_images_and_of_poses_alone(tmp_path: Path) -> None:
    """Photographs of another size than the scene's frames at poses of their own; and poses where there is nothing to show beside."""
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", truth=False)
    views = [PosedCamera(Camera(30, 20, 30.0, 30.0, 15.0, 10.0), ring_pose(i, 7), f"photo{i}") for i in range(2)]
    images = []
    for view in views:
        images.append(tmp_path / f"{view.name}.png")
        write_png16(images[-1], np.random.default_rng(0).random((20, 30)))
    for given in (images, []):
        out, sensor = tmp_path / str(len(given)), field.sensors["rgb"]
        written = convert_files(field, scene, out, source="rgb", target="ms", views=views, images=given, method="field")  # type: ignore[arg-type]
        sidecars = [path for path in written if path.suffix == ".json"]
        page = check(write_conversion_report(out, sidecars, sensor, source_previews(scene, sensor, given)))
        assert [section.all("h3")[0].text for section in page.root.all("section", class_="modality")] == ["frame photo0", "frame photo1"]
        assert len(page.root.all("figure", class_="wipe")) == len(given)


def test_bench(tmp_path: Path) -> None:
    rows = [{"name": "<a>", "psnr": 31.257}, {"name": "b", "psnr": None}]
    tables = [Table("Speed & error", (Column("name", "name"), Column("PSNR", "psnr", ".2f"), Column("none", "sam")), rows, "A note.")]
    figure, (axes,) = new_figure(1)
    axes.plot([1, 2], [3, 4])
    report = write_report({"bench": "render", "machine": measure(), "rows": rows}, tables, figure, tmp_path)
    assert report.files == ("results.json", "report.md", "report.html", "plot.svg")
    page = check(tmp_path / "report.html")
    assert page.table("Speed & error") == [["name", "PSNR"], ["<a>", "31.26"], ["b", "–"]]
    assert page.root.all("svg") and "A note." in page.source
    assert {a.attributes["href"] for a in page.root.all("a")} >= {"results.json", "report.md", "plot.svg"}
