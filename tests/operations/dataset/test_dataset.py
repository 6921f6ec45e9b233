"""Datasets: complete, resumable, verifiable, the same bytes every time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import POL, RGB, AnalyticField, ring_pose, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.operations.dataset.generate import generate_dataset
from mmsynth.operations.dataset.index import verify_dataset
from mmsynth.operations.dataset.plan import DATASET_FORMATS
from mmsynth.operations.output.records import read_record
from mmsynth.operations.output.work_partition import WorkPartition, partition_of_environment
from mmsynth.operations.views.coverage import training_rays
from mmsynth.operations.views.flow import optical_flow
from mmsynth.scene.images import read_image
from mmsynth.scene.load import read_poses
from mmsynth.scene.scene import PosedCamera, Region
from mmsynth.sensors.camera import Camera


def views_of(field: AnalyticField, count: int = 2) -> list[PosedCamera]:
    return [PosedCamera(field.cameras["rgb"], ring_pose(i, 7), f"view {i}") for i in range(count)]


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("rig", ["aligned", "native"])
@pytest.mark.parametrize("file_format", DATASET_FORMATS)
def test_complete_and_identical_on_rerun(tmp_path: Path, rig: Any, file_format: Any) -> None:
    field = AnalyticField(sphere())
    calls: list[tuple[int, int]] = []
    path = generate_dataset(
        field, views_of(field), tmp_path / "a", rig=rig, file_format=file_format, progress=lambda *c: calls.append(c)
    ).path  # type: ignore[arg-type]
    assert path == tmp_path / "a/dataset.json" and verify_dataset(tmp_path / "a") == []
    assert calls[-1][0] == calls[-1][1] and calls == sorted(calls)
    stated = json.loads(path.read_text())
    assert set(stated["modalities"]) == {"rgb", "ms", "pol", "mono"} and stated["unit"] == "m" and len(stated["field"]) == 64
    for view in stated["views"] if file_format != "webdataset" else []:
        on_disk = {p.name for p in (tmp_path / "a" / view["folder"]).iterdir()}
        assert on_disk == {name for name in view["files"] if "/" not in name} | {"view.json"}
    generate_dataset(field, views_of(field), tmp_path / "b", rig=rig, file_format=file_format)  # type: ignore[arg-type]
    assert content(tmp_path / "a") == content(tmp_path / "b")


def test_values_in_every_format(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    view = views_of(field)[0]
    truth = field.render(view.camera, view.camera_to_world)
    file_format: Any
    for file_format in ("npz", "exr", "tiff"):
        generate_dataset(field, views_of(field, 1), tmp_path / file_format, file_format=file_format)  # type: ignore[arg-type]
    with np.load(tmp_path / "npz/views/0000/geometry.npz") as arrays:
        for key in ("depth_z", "depth_ray", "normal", "opacity"):
            assert np.array_equal(arrays[key], getattr(truth, key), equal_nan=True), key
        assert np.array_equal(arrays["mask"], truth.opacity > 0.5)
    exr = read_image(tmp_path / "exr/views/0000/ms.exr")
    assert sorted(exr[9, 12]) == pytest.approx(sorted(truth.channels["ms"][9, 12]))
    assert np.allclose(read_image(tmp_path / "tiff/views/0000/ms.tiff"), truth.channels["ms"], atol=1 / 65535)
    assert np.array_equal(read_image(tmp_path / "tiff/views/0000/pol_stokes.tiff"), truth.stokes["pol"])


def test_native_rig(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    generate_dataset(field, views_of(field), tmp_path, modalities=["rgb", "polarization"], rig="native")  # type: ignore[arg-type]
    pose = ring_pose(1, 7) @ field.rig["pol"]
    truth = field.render(field.cameras["pol"], pose, ["pol"])
    with np.load(tmp_path / "views/0001/pol.npz") as arrays:
        assert np.array_equal(arrays["data"], truth.channels["pol"], equal_nan=True)
    with np.load(tmp_path / "views/0001/geometry_pol.npz") as arrays:
        assert np.array_equal(arrays["depth_z"], truth.depth_z, equal_nan=True)
    assert np.allclose(read_poses(tmp_path / "transforms_pol.json")[1].camera_to_world, pose)


def test_transforms_come_back(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    generate_dataset(field, views_of(field), tmp_path)  # type: ignore[arg-type]
    for view, read in zip(views_of(field), read_poses(tmp_path / "transforms.json"), strict=True):
        assert read.camera is not None
        assert np.allclose(read.camera_to_world, view.camera_to_world, atol=1e-12)
        assert np.allclose(read.camera.matrix, view.camera.matrix)
        assert np.allclose(read.camera.coefficients, view.camera.coefficients)


def test_resumes(tmp_path: Path) -> None:
    """Finished views are kept; a missing, cut-off or foreign one is made again."""
    field = AnalyticField(sphere())

    def renders(radius: float = 0.6) -> int:
        again = AnalyticField(sphere(radius))
        generate_dataset(again, views_of(field, 3), tmp_path)  # type: ignore[arg-type]
        return again.renders

    assert renders() == 3
    before = content(tmp_path)
    assert renders() == 0
    (tmp_path / "views/0000/view.json").unlink()
    assert renders() == 1
    (tmp_path / "views/0001/ms.npz").write_bytes(before["views/0001/ms.npz"][:-1])
    assert renders() == 1
    (tmp_path / "views/0002/view.json").write_text("{")
    assert renders() == 1
    assert content(tmp_path) == before
    assert renders(0.5) == 3  # another field


@pytest.mark.parametrize("file_format", ["npz", "webdataset"])
def test_processes_make_the_same_bytes_as_one(tmp_path: Path, file_format: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever comes last writes the summary; nobody waits, and a view at the border of two shares has its flow to the next."""
    monkeypatch.setattr("mmsynth.operations.dataset.generate.PER_SHARD", 2)
    monkeypatch.setattr("mmsynth.operations.dataset.index.PER_SHARD", 2)
    field: Any = AnalyticField(sphere())
    generate_dataset(field, views_of(field, 5), tmp_path / "one", file_format=file_format)
    written = [
        generate_dataset(field, views_of(field, 5), tmp_path / "many", file_format=file_format, part=WorkPartition(k, 3)).path
        for k in (2, 0, 1)
    ]
    assert written == [None, None, tmp_path / "many/dataset.json"]
    assert content(tmp_path / "one") == content(tmp_path / "many")
    assert len(json.loads(written[2].read_text())["views"]) == 5 and verify_dataset(tmp_path / "many") == []  # type: ignore[union-attr]


def test_views_whose_shard_is_still_to_come_are_not_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process has rendered its views and is about to pack them."""
    monkeypatch.setattr("mmsynth.operations.dataset.generate.PER_SHARD", 2)
    monkeypatch.setattr("mmsynth.operations.dataset.index.PER_SHARD", 2)
    field: Any = AnalyticField(sphere())
    make = lambda out, **how: generate_dataset(field, views_of(field, 4), out, file_format="webdataset", **how).path
    make(tmp_path / "one")
    with monkeypatch.context() as late:
        late.setattr("mmsynth.operations.dataset.generate.pack_shard", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            make(tmp_path / "two", part=WorkPartition(0, 2))
    assert make(tmp_path / "two", part=WorkPartition(1, 2)) is None
    assert make(tmp_path / "two", part=WorkPartition(0, 2)) is not None and content(tmp_path / "one") == content(tmp_path / "two")


def test_shares_cover_everything_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for units, together, processes in [(10, 1, 3), (10, 4, 3), (3, 1, 8), (130, 64, 2), (0, 1, 2)]:
        shares = [WorkPartition(k, processes).of(units, together) for k in range(processes)]
        assert [i for share in shares for i in share] == list(range(units))
        assert all(share.start % together == 0 for share in shares if len(share))
    for rank, size, good in [("1", "4", True), ("4", "4", False), ("a", "2", False), ("-1", "2", False)]:
        monkeypatch.setenv("RANK", rank)
        monkeypatch.setenv("WORLD_SIZE", size)
        if good:
            assert partition_of_environment() == WorkPartition(1, 4)
        else:
            with pytest.raises(InputError, match=f"RANK is '{rank}' and WORLD_SIZE '{size}'"):
                partition_of_environment()


def test_a_shard_that_was_cut_off_is_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mmsynth.operations.dataset.generate.PER_SHARD", 2)
    monkeypatch.setattr("mmsynth.operations.dataset.index.PER_SHARD", 2)
    field: Any = AnalyticField(sphere())
    generate_dataset(field, views_of(field, 5), tmp_path / "whole", file_format="webdataset")
    before = content(tmp_path / "whole")

    def again(made: int) -> None:
        counted = AnalyticField(sphere())
        generate_dataset(counted, views_of(field, 5), tmp_path / "whole", file_format="webdataset")  # type: ignore[arg-type]
        assert content(tmp_path / "whole") == before and counted.renders == made

    again(0)
    (tmp_path / "whole/shards/000001.json").unlink()
    again(3)  # its two views, and the depth of the next for the flow
    path = tmp_path / "whole/shards/000002.tar"
    path.write_bytes(path.read_bytes()[:-1])
    assert [p for p in verify_dataset(tmp_path / "whole") if "000002.tar" in p]
    again(1)
    folder = tmp_path / "whole/views/0000"  # killed between the sidecar and the removal of the folders
    folder.mkdir(parents=True)
    (folder / "rgb.npz").write_bytes(b"left over")
    again(0)


def test_flow_coverage_and_what_was_asked_for(tmp_path: Path) -> None:
    field: Any = AnalyticField(sphere())
    views = views_of(field, 3)
    rays = training_rays(field, scene_of(field, tmp_path / "scene", views=4, truth=False))
    generate_dataset(field, views, tmp_path / "all", modalities=["mono"], rays=rays)
    seen = [field.render(view.camera, view.camera_to_world, ["mono"]) for view in views]
    for i in range(2):
        flow, occluded = optical_flow(views[i], seen[i].depth_ray, seen[i].normal, views[i + 1], seen[i + 1].depth_ray)
        with np.load(tmp_path / f"all/views/{i:04d}/flow.npz") as arrays:
            assert np.array_equal(arrays["flow"], flow, equal_nan=True) and np.array_equal(arrays["occluded"], occluded)
    view = json.loads((tmp_path / "all/views/0001/view.json").read_text())
    with np.load(tmp_path / "all/views/0001/geometry.npz") as arrays:
        assert view["coverage_score"] == pytest.approx(np.nanmean(arrays["coverage"]), rel=1e-6) and 0 < view["coverage_score"] < 1
        assert np.array_equal(np.isnan(arrays["coverage"]), np.isnan(arrays["depth_z"])) and not arrays["saturated_mono"].any()
    generate_dataset(field, views, tmp_path / "few", modalities=["mono"], outputs=[])
    assert {p.name for p in (tmp_path / "few/views/0000").iterdir()} == {"mono.npz", "image.png", "view.json"}
    generate_dataset(field, views, tmp_path / "flow", modalities=["mono"], outputs=["flow"])
    assert {p.name for p in (tmp_path / "flow/views/0000").iterdir()} == {"mono.npz", "flow.npz", "image.png", "view.json"}
    # another next view: another flow, so another request
    counted = AnalyticField(sphere())
    generate_dataset(counted, [*views[:2], views[0]], tmp_path / "all", modalities=["mono"], rays=rays)  # type: ignore[arg-type]
    assert counted.renders == 2


def test_a_run_that_is_cut_off_has_no_summary_of_the_last_one(tmp_path: Path) -> None:
    field: Any = AnalyticField(sphere())
    generate_dataset(field, views_of(field, 2), tmp_path)
    other: Any = AnalyticField(sphere(0.5))
    other.render = lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        generate_dataset(other, views_of(field, 2), tmp_path)
    assert not (tmp_path / "dataset.json").exists()
    generate_dataset(field, views_of(field, 2), tmp_path)
    assert verify_dataset(tmp_path) == []


def test_verify_finds_damage(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    generate_dataset(field, views_of(field, 3), tmp_path)  # type: ignore[arg-type]
    (tmp_path / "views/0000/rgb.npz").unlink()
    damaged = bytearray((tmp_path / "views/0001/ms.npz").read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (tmp_path / "views/0001/ms.npz").write_bytes(damaged)
    (tmp_path / "views/0002/view.json").unlink()
    problems = verify_dataset(tmp_path)
    assert len(problems) == 3
    for problem, name in zip(problems, ("0000/rgb.npz", "0001/ms.npz", "0002/view.json"), strict=True):
        assert name in problem.replace("\\", "/")


@pytest.mark.parametrize("file_format", ["npz", "exr", "tiff"])
def test_light_is_a_record_of_its_own(tmp_path: Path, file_format: Any) -> None:
    torch.manual_seed(0)
    sizes: dict[str, Any] = {
        "surface_rows_log2": 10,
        "radiance_rows_log2": 10,
        "surface_levels": 2,
        "radiance_levels": 2,
        "surface_hidden": 8,
    }
    field = Field(Design(light=True, **sizes), {s.name: s for s in (RGB, POL)}, {"rgb": 0.5, "pol": 0.2}, Region((0.0, 0.0, 0.0), 1.0))
    assert field.light is not None
    field.light.add(torch.tensor([[0.0, 1.0, 4.0], [3.0, 0.0, 2.0]]))
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 2.0
    view = PosedCamera(Camera(24, 16, 20.0, 20.0, 11.5, 7.5), pose, "one")
    made = generate_dataset(field, [view], tmp_path, file_format=file_format, outputs=["light"])
    assert made.path is not None and verify_dataset(tmp_path) == []
    files = json.loads((tmp_path / "views/0000/view.json").read_text())["files"]
    light, rgb = (read_record(tmp_path / "views/0000", files, record) for record in ("light", "rgb"))
    assert set(light) == {"mirrored_rgb", "mirrored_pol", "roughness", "strength"}
    assert light["mirrored_rgb"].shape == (16, 24, 3) and light["mirrored_pol"].shape == (16, 24, 4)
    assert light["mirrored_rgb"].max() > 0.01 and (rgb["data"] - light["mirrored_rgb"]).min() > -1e-4
    assert not {name for name in files if name.startswith("geometry")}


def test_refuses(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    views = views_of(field)
    out = tmp_path / "out"
    for arguments, message in [
        ({"rig": "both"}, "aligned, native"),
        ({"file_format": "jpg"}, "npz, exr, tiff"),
        ({"modalities": ["thermal"]}, "'thermal'"),
        ({"modalities": []}, "no modalities"),
        ({"outputs": ["masks"]}, "output 'masks', expected some of geometry, flow, coverage, light"),
        ({"outputs": ["coverage"]}, "coverage needs the rays"),
        ({"outputs": ["light"]}, "no lamps"),
    ]:
        with pytest.raises(InputError, match=message):
            generate_dataset(field, views, out, **arguments)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no views"):
        generate_dataset(field, [], out)  # type: ignore[arg-type]
    del field.rig["pol"]
    with pytest.raises(InputError, match="'pol' has no known place"):
        generate_dataset(field, views, out, rig="native")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"dataset\.json"):
        verify_dataset(out)
    assert not out.exists()
