"""What can be looked at, by name, and its pictures."""

from __future__ import annotations

import numpy as np
import pytest
from analytic import MONO, MS, POL, RGB, AnalyticField, ring_pose, sphere

from mmsynth.errors import InputError
from mmsynth.operations.output import previews
from mmsynth.operations.views.displays import (
    at_wavelength,
    bands_of,
    channel_names,
    displays_of,
    exposure_key,
    exposures_of,
    find_display,
    is_light,
    label_of,
    linear_of,
    look,
    picture,
)
from mmsynth.scene.scene import PosedCamera, Sensor

FIELD = AnalyticField(sphere(), mirrored=0.2)
VIEW = PosedCamera(FIELD.cameras["rgb"], ring_pose(0, 4))


def test_every_display_has_a_name_that_finds_it_and_a_picture() -> None:
    found = displays_of(FIELD)
    assert len({display.name for display in found}) == len(found)
    seen = look(FIELD, VIEW, found)
    assert seen is not None
    seen = {**seen, "coverage": np.full(seen["depth"].shape, 0.5, np.float32)}
    for display in found:
        assert find_display(FIELD, display.name) == display
        image = picture(FIELD, display, seen)
        assert image.dtype == np.uint8 and image.shape == (18, 24, 3), display.name
        assert image.max() > 0, display.name


@pytest.mark.parametrize(
    ("text", "name"),
    [("RGB", "rgb"), ("dolp", "pol:dolp"), ("polarization:aolp", "pol:aolp"), ("specular", "rgb:specular"), (" ms:pan ", "ms:pan")],
)
def test_names_may_be_short_or_aliases(text: str, name: str) -> None:
    assert find_display(FIELD, text).name == name


def test_what_is_seen_is_what_the_field_renders() -> None:
    seen, rendered = look(FIELD, VIEW, displays_of(FIELD)), FIELD.render(VIEW.camera, VIEW.camera_to_world)
    assert seen is not None
    for name in FIELD.sensors:
        np.testing.assert_array_equal(seen[name], rendered.channels[name])
    np.testing.assert_array_equal(seen["stokes/pol"], rendered.stokes["pol"])
    np.testing.assert_array_equal(seen["depth_z"], rendered.depth_z)


def test_channels_by_number_label_and_mixture() -> None:
    seen = look(FIELD, VIEW, [find_display(FIELD, "ms"), find_display(FIELD, "mono")])
    assert seen is not None
    for text in ("ms:5", "ms:503"):
        np.testing.assert_allclose(linear_of(FIELD, find_display(FIELD, text), seen)[..., 1], np.nan_to_num(seen["ms"][..., 5]))
    mixed = linear_of(FIELD, find_display(FIELD, "ms:0/mono/ms:464"), seen)
    for k, expected in enumerate((seen["ms"][..., 0], seen["mono"][..., 0], seen["ms"][..., 6])):
        np.testing.assert_allclose(mixed[..., k], np.nan_to_num(expected))


def test_a_wavelength_lies_between_its_bands() -> None:
    seen = look(FIELD, VIEW, [find_display(FIELD, "ms")])
    assert seen is not None
    ms = np.nan_to_num(seen["ms"])
    np.testing.assert_allclose(linear_of(FIELD, at_wavelength(FIELD, 541.0), seen)[..., 0], ms[..., 4])
    between = linear_of(FIELD, find_display(FIELD, "548.75nm"), seen)[..., 0]  # a quarter of the way from 541 to 572
    np.testing.assert_allclose(between, 0.75 * ms[..., 4] + 0.25 * ms[..., 3], rtol=1e-6)
    for nm in (430.0, 700.0):
        with pytest.raises(InputError, match=r"channels: 431 to 692 nm"):
            at_wavelength(FIELD, nm)
    assert [nm for nm, *_ in bands_of(FIELD)] == sorted(nm for nm in MS.wavelengths_nm if nm is not None)


def test_bands_of_the_modality_that_has_most_of_them_are_mixed() -> None:
    few = Sensor("nir", ("a", "b"), (450.0, 900.0))
    field = AnalyticField(sphere(), [few, MS])
    assert at_wavelength(field, 548.0).modalities == ("ms",)
    assert at_wavelength(field, 800.0).modalities == ("nir",)


def test_light_is_its_diffuse_and_specular_part() -> None:
    seen = look(FIELD, VIEW, [find_display(FIELD, "rgb:diffuse")])
    assert seen is not None
    whole, diffuse, specular = (linear_of(FIELD, find_display(FIELD, f"rgb{part}"), seen) for part in ("", ":diffuse", ":specular"))
    assert specular.max() > 0.01
    np.testing.assert_allclose(diffuse + specular, whole, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("thermal", "nothing of this field, expected some of rgb, ms, pol, mono"),
        ("ms:12", "no such channel, expected one of 692, 653"),
        ("ms:blue", "no such channel"),
        ("ms/rgb/mono", "no such channel"),  # which of nine?
        ("rgb:aolp", "no polarization modality"),
        ("mono:deviation", "was measured"),
    ],
)
def test_what_is_not_there_is_said(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        find_display(FIELD, text)


def test_a_field_without_lamps_or_polarization_says_so() -> None:
    field = AnalyticField(sphere(), [RGB, MONO])
    assert not any(is_light(d) and d.kind in ("diffuse", "s0") for d in displays_of(field))
    for text in ("specular", "aolp"):
        with pytest.raises(InputError, match=text):
            find_display(field, text)


def test_exposure_is_that_of_the_modality_for_all_its_parts() -> None:
    displays = [find_display(FIELD, text) for text in ("rgb", "rgb:R", "rgb:specular", "ms:0/mono/ms:4", "depth")]
    seen = look(FIELD, VIEW, displays)
    assert seen is not None
    exposures = exposures_of(FIELD, displays, seen)
    assert set(exposures) == {"rgb", "ms:0/mono/ms:4"} and [exposure_key(d) for d in displays[:3]] == ["rgb"] * 3
    assert exposures["rgb"] == previews.exposure_of(linear_of(FIELD, displays[0], seen))
    dark, bright = (picture(FIELD, displays[0], seen, exposures["rgb"] * gain).astype(int) for gain in (0.5, 2.0))
    assert (bright >= dark).all() and bright.sum() > dark.sum()


def test_it_stops_when_nobody_wants_it_any_more() -> None:
    assert look(FIELD, VIEW, [find_display(FIELD, "rgb")], lambda: False) is None


def test_predicted_modalities_have_a_star() -> None:
    field = AnalyticField(sphere(), [RGB, POL])
    field.predicted = ["pol"]
    assert [label_of(field, find_display(field, text)) for text in ("rgb", "pol:aolp", "pol:0")] == ["rgb", "pol:aolp *", "pol:0 *"]
    assert channel_names(field) == ["rgb:R", "rgb:G", "rgb:B"]
