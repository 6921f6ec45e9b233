"""Datasets as tensors: the same from every format, by torch's loader and the webdataset package; mirrored pictures of polarization."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import POL, AnalyticField, ring_pose, scene_of, sphere
from conftest import look_at
from torch.utils.data import DataLoader

import mmsynth
from mmsynth.errors import InputError
from mmsynth.operations.dataset.aligned import AlignedDataset, crop_and_flip
from mmsynth.operations.dataset.generate import generate_dataset
from mmsynth.operations.dataset.plan import DATASET_FORMATS
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.polarization import angle_of_linear_polarization, aolp_difference, intensities_to_stokes

CAMERA = Camera(24, 18, 26.0, 26.0, 11.3, 8.6, (-0.1, 0.05, 0.001, -0.002))


def made(folder: Path, format: str, count: int = 3, **how: Any) -> AlignedDataset:
    field: Any = AnalyticField(sphere())
    generate_dataset(field, [PosedCamera(CAMERA, ring_pose(i, 9), f"{i}") for i in range(count)], folder, file_format=format, **how)
    return AlignedDataset(folder)


@pytest.mark.parametrize("format", DATASET_FORMATS)
def test_every_format_gives_the_same_tensors(tmp_path: Path, format: str) -> None:
    field = AnalyticField(sphere())
    dataset = made(tmp_path, format)
    assert len(dataset) == 3 and dataset.modalities == ["rgb", "ms", "pol", "mono"]
    truth, item = field.render(CAMERA, ring_pose(1, 9)), dataset[1]
    coarse = 0.51 / 65535 if format in ("tiff", "mms-data") else 0.0
    for name in dataset.modalities:
        valid = truth.valid
        np.testing.assert_allclose(item[name].numpy()[:, valid], np.moveaxis(truth.channels[name], -1, 0)[:, valid], rtol=0, atol=coarse)
    np.testing.assert_array_equal(item["pol/stokes"].numpy(), np.moveaxis(truth.stokes["pol"], -1, 0))
    for key in ("depth_z", "depth_ray", "opacity"):
        np.testing.assert_array_equal(item[key][0].numpy(), getattr(truth, key))
    np.testing.assert_array_equal(item["normal"].numpy(), np.moveaxis(truth.normal, -1, 0))
    turned = np.einsum("ji,jhw->ihw", ring_pose(1, 9)[:3, :3], item["normal"].numpy())
    np.testing.assert_allclose(item["normal_camera"].numpy(), turned, atol=1e-6)
    assert item["mask"].dtype == item["occluded"].dtype == item["saturated_ms"].dtype == torch.bool
    assert item["flow"].shape == (2, 18, 24) and "flow" not in dataset[2]
    np.testing.assert_array_equal(item["intrinsics"].numpy(), CAMERA.matrix)
    np.testing.assert_array_equal(item["camera_to_world"].numpy(), ring_pose(1, 9))
    batch = next(iter(DataLoader(AlignedDataset(tmp_path, ["rgb", "multispectral"], geometry=False), batch_size=3)))
    assert set(batch) == {"rgb", "ms", "intrinsics", "camera_to_world"} and batch["ms"].shape == (3, 9, 18, 24)


def test_a_native_rig_has_a_grid_of_each(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    item = made(tmp_path, "npz", rig="native")[0]
    pose = ring_pose(0, 9) @ field.rig["pol"]
    np.testing.assert_array_equal(item["pol/depth_z"][0].numpy(), field.render(field.cameras["pol"], pose, []).depth_z)
    np.testing.assert_allclose(item["pol/camera_to_world"].numpy(), pose, atol=1e-15)
    assert "rgb/flow" in item and "depth_z" not in item


def test_shards_stream_through_webdataset(tmp_path: Path) -> None:
    import webdataset

    dataset = made(tmp_path, "webdataset")
    stream = webdataset.WebDataset(str(tmp_path / "shards/000000.tar"), shardshuffle=False).decode()
    samples = list(stream)
    assert [sample["__key__"] for sample in samples] == ["0000", "0001", "0002"]
    for sample, item in zip(samples, dataset, strict=True):  # type: ignore[call-overload]
        np.testing.assert_array_equal(np.moveaxis(sample["ms.npz"]["data"], -1, 0), item["ms"].numpy())
        np.testing.assert_array_equal(sample["geometry.npz"]["depth_z"], item["depth_z"][0].numpy())
        assert sample["json"]["cameras"]["rgb"]["width"] == 24
    assert not list((tmp_path / "views").glob("*"))


def test_scenes_whose_modalities_share_their_pixels(tmp_path: Path) -> None:
    """The layout of MMS-DATA without our own summary is an aligned dataset, too, and a scene that can be fitted."""
    written = made(tmp_path / "a", "mms-data")
    items = [written[i] for i in range(3)]
    scene = mmsynth.load_scene(tmp_path / "a")
    assert set(scene.sensors) == {"rgb", "ms", "pol", "mono"} and all(s.mosaic is None for s in scene.sensors.values())
    np.testing.assert_allclose(scene.frames_of("ms")[2].camera_to_world, ring_pose(2, 9), atol=1e-12)
    (tmp_path / "a/dataset.json").unlink()
    plain = AlignedDataset(tmp_path / "a")
    assert plain.polarizer_angles_deg == {"pol": (0.0, 45.0, 90.0, 135.0)}
    for i in range(3):
        for name in plain.modalities:
            torch.testing.assert_close(plain[i][name], items[i][name], rtol=0, atol=0)
    scene_of(AnalyticField(sphere()), tmp_path / "raw", views=2, truth=False)
    with pytest.raises(InputError):
        AlignedDataset(tmp_path / "raw")


def test_the_nerfstudio_layout_has_the_same_poses(tmp_path: Path) -> None:
    made(tmp_path, "tiff", rig="aligned")
    scene = mmsynth.load_scene(tmp_path)
    for i, frame in enumerate(scene.frames_of("rgb")):
        np.testing.assert_allclose(frame.camera_to_world, ring_pose(i, 9), rtol=0, atol=1e-12)
        np.testing.assert_allclose(frame.camera.coefficients, CAMERA.coefficients, rtol=0, atol=1e-12)


def test_refuses(tmp_path: Path) -> None:
    dataset = made(tmp_path, "npz")
    with pytest.raises(InputError, match="no modality 'thermal', expected some of rgb, ms, pol, mono"):
        AlignedDataset(tmp_path, ["thermal"])
    with pytest.raises(IndexError):
        dataset[3]
    (tmp_path / "views/0001/ms.npz").unlink()
    with pytest.raises(InputError, match=r"ms\.npz: damaged or missing"):
        dataset[1]
    with pytest.raises(InputError):
        AlignedDataset(tmp_path / "nothing")
    shards = made(tmp_path / "w", "webdataset")
    (tmp_path / "w/shards/000000.tar").write_bytes(b"no tar")
    with pytest.raises(InputError, match=r"000000\.tar: missing or damaged shard"):
        AlignedDataset(tmp_path / "w")
    assert len(shards) == 3


def test_a_mirrored_picture_is_that_of_a_mirrored_scene(tmp_path: Path) -> None:
    """A scene that is its own mirror image, seen from its plane of symmetry: mirroring its picture must change nothing."""
    camera = Camera(25, 19, 26.0, 26.0, 12.0, 9.0)
    light = np.array([0.3, -0.5, 0.8])
    pose = look_at(2.5 * np.array([0.3, -0.5, 0.3]))
    field: Any = AnalyticField(sphere())  # its light lies in the plane of symmetry, as the camera does
    generate_dataset(field, [PosedCamera(camera, pose, "0"), PosedCamera(camera, pose, "1")], tmp_path)
    assert abs(np.linalg.det(np.stack([light, pose[:3, 3], [0, 0, 1]]))) < 1e-12
    dataset = AlignedDataset(tmp_path)
    item = dataset[0]
    flipped = None
    for seed in range(8):
        generator = torch.Generator().manual_seed(seed)
        again = crop_and_flip(item, (19, 25), generator, dataset.polarizer_angles_deg)
        if torch.allclose(again["rgb"], item["rgb"].flip(-1)) and not torch.equal(again["pol/stokes"], item["pol/stokes"]):
            flipped = again
            break
    assert flipped is not None
    # where the surface faces the camera polarization has no direction
    lit = (item["opacity"][0] > 0.5) & (item["normal_camera"][:2].norm(dim=0) > 0.1)
    for key in ("pol", "pol/stokes", "rgb", "normal_camera"):
        torch.testing.assert_close(flipped[key][:, lit], item[key][:, lit], rtol=0, atol=2e-3)
    naive = item["pol/stokes"].flip(-1)  # what a flip without knowledge of angles gives
    wrong = aolp_difference(*(angle_of_linear_polarization(s[:, lit].T) for s in (naive, item["pol/stokes"]))).abs().mean()
    right = aolp_difference(*(angle_of_linear_polarization(s[:, lit].T) for s in (flipped["pol/stokes"], item["pol/stokes"]))).abs().mean()
    assert wrong > 20.0 > 0.5 > right


def test_crops_move_the_principal_point_and_analysers_follow_their_stokes(tmp_path: Path) -> None:
    dataset = made(tmp_path, "npz")
    item, mirrored = dataset[0], 0
    for seed in range(12):
        out = crop_and_flip(item, (8, 10), torch.Generator().manual_seed(seed), dataset.polarizer_angles_deg)
        assert out["rgb"].shape == (3, 8, 10) and "normal" not in out and "camera_to_world" not in out
        back = intensities_to_stokes(out["pol"].movedim(0, -1), POL.polarizer_angles_deg or ())
        torch.testing.assert_close(back.movedim(-1, 0), out["pol/stokes"], rtol=0, atol=1e-6, equal_nan=True)
        # the surface point behind a pixel is where the moved camera says
        top = next(
            t for t in range(11) for x in range(15) if torch.equal(item["depth_z"][0, t : t + 8, x : x + 10].nan_to_num(), _unflipped(out))
        )
        assert float(out["intrinsics"][1, 2]) == pytest.approx(CAMERA.cy - top)
        mirrored += float(out["intrinsics"][0, 2]) != pytest.approx(CAMERA.cx - round(CAMERA.cx - float(out["intrinsics"][0, 2])))
    assert 0 < mirrored < 12
    with pytest.raises(InputError, match="30x8 pixels of 24x18"):
        crop_and_flip(item, (8, 30), torch.Generator(), {})
    with pytest.raises(InputError, match="analysers of 'pol' at 0, 30 deg have no mirror images"):
        for seed in range(20):
            crop_and_flip({"pol": torch.zeros(2, 5, 5)}, (5, 5), torch.Generator().manual_seed(seed), {"pol": (0.0, 30.0)})


def _unflipped(out: dict[str, torch.Tensor]) -> torch.Tensor:
    """The crop's depth as it was before mirroring; the principal point tells: cx = 11.3 leaves a fraction of 0.3, mirrored 0.7."""
    fraction = float(out["intrinsics"][0, 2]) % 1.0
    depth = out["depth_z"][0].nan_to_num()
    return depth if abs(fraction - 0.3) < 1e-6 else depth.flip(-1)
