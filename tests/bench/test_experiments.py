"""The tables of papers as data: what is refused, and which fits their rows ask for."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest

from mmsynth.bench.experiments import PACKAGED, Fit, Row, fit_of, load_experiments
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import Recipe
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene

FIVE = ("rgb", "nir", "mono", "pol", "ms")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The example: five modalities, 22 training views."""
    return load_scene(data_folder("example_scene"))


def fits(name: str, scene: Scene) -> dict[str, dict[str, Fit]]:
    """Of a packaged table: row → modality → fit."""
    rows = [row for given in load_experiments([name])[name].row for row in given.repeated(list(scene.sensors))]
    found = {row.name: {m: fit for m in scene.sensors if (fit := fit_of(row, m, scene)) is not None} for row in rows}
    assert len(found) == len(rows)
    return found


def everything(frames: int | None = None, rays: float = 1.0) -> Fit:
    return Fit(FIVE, () if frames is None else tuple((name, frames) for name in FIVE), rays, "raw")


def test_the_papers_tables_are_there() -> None:
    assert tuple(load_experiments()) == PACKAGED and set(PACKAGED) == {p.stem for p in (data_folder("recipes") / "paper").iterdir()}
    assert list(load_experiments(["pairs", "half"])) == ["pairs", "half"]


def test_alone_and_together(scene: Scene) -> None:
    rows = fits("together", scene)
    assert rows["alone"] == {name: Fit((name,), (), 1.0, "raw") for name in FIVE}
    assert rows["together"] == dict.fromkeys(FIVE, everything())


def test_every_pair_is_one_fit_that_two_rows_share(scene: Scene) -> None:
    rows = fits("pairs", scene)
    for a, b in combinations(FIVE, 2):
        assert rows[f"with {a}"][b] == rows[f"with {b}"][a] == Fit((a, b), (), 1.0, "raw")
    assert all(name not in rows[f"with {name}"] for name in FIVE) and set(rows["alone"]) == set(FIVE)
    assert len({fit for row in rows.values() for fit in row.values()}) == 10 + 5


def test_half_of_the_views_and_half_of_the_rays(scene: Scene) -> None:
    rows = fits("half", scene)
    assert rows["together, half of the views"] == dict.fromkeys(FIVE, everything(11))
    assert rows["together, half of the rays"] == dict.fromkeys(FIVE, everything(rays=0.5))
    assert rows["alone, half of the views"]["ms"] == Fit(("ms",), (("ms", 11),), 1.0, "raw")
    assert rows["alone, half of the rays"]["ms"] == Fit(("ms",), (), 0.5, "raw")


def test_unbalanced(scene: Scene) -> None:
    rows = fits("unbalanced", scene)
    assert rows["10 frames beside all of rgb"] == {m: Fit(("rgb", m), ((m, 10),), 1.0, "raw") for m in FIVE[1:]}
    for name in FIVE:  # a tenth of 22
        expected = Fit(FIVE, tuple((m, 2) for m in FIVE if m != name), 1.0, "raw")
        assert rows[f"together, all of {name}, a tenth of the others"] == dict.fromkeys(FIVE, expected)


def test_few_frames_are_those_that_a_scene_can_spare(scene: Scene) -> None:
    rows = fits("few-frames", scene)
    for count in (1, 3, 5, 10):
        assert rows[f"rgb + {count} frame{'s' * (count > 1)}"] == {m: Fit(("rgb", m), ((m, count),), 1.0, "raw") for m in FIVE[1:]}
    assert rows["rgb + 25 frames"] == {}  # of 22: it would be the row of all
    assert rows["rgb + all frames"]["pol"] == Fit(("rgb", "pol"), (), 1.0, "raw")
    # the other modalities have scores where a field knows them without having seen them
    assert fits("rgb-only", scene)["rgb only"] == dict.fromkeys(FIVE, Fit(("rgb",), (), 1.0, "raw"))


def test_rows_with_a_prior_are_those_without_it(scene: Scene) -> None:
    rows = fits("few-frames", scene) | fits("rgb-only", scene)
    for name in ("rgb only", "rgb + 1 frame", "rgb + 10 frames"):
        assert rows[f"{name}, prior"] == {m: replace(fit, prior=True) for m, fit in rows[name].items()}


def test_a_scene_without_the_modality_has_no_such_fit(scene: Scene) -> None:
    without = replace(scene, sensors={name: sensor for name, sensor in scene.sensors.items() if name != "rgb"})
    rows = fits("few-frames", without)
    assert all(not row for row in rows.values())
    assert fits("pairs", without)["with nir"].keys() == {"mono", "pol", "ms"}
    assert fit_of(Row(name="aliases", modalities=["infrared", "scored"]), "ms", scene) == Fit(("nir", "ms"), (), 1.0, "raw")


def test_frames_without_mosaic_and_lens_are_not_demosaicked(scene: Scene) -> None:
    assert fits("mosaics", scene)["demosaicked and undistorted"] == dict.fromkeys(FIVE, Fit(FIVE, (), 1.0, "demosaicked"))
    sensors = {name: replace(sensor, mosaic=None) for name, sensor in scene.sensors.items()}
    frames = tuple(replace(frame, camera=replace(frame.camera, distortion=())) for frame in scene.frames)
    assert fits("mosaics", replace(scene, sensors=sensors, frames=frames))["demosaicked and undistorted"] == {}
    assert fits("mosaics", replace(scene, sensors=sensors))["demosaicked and undistorted"] != {}  # there are lenses


def test_names_of_fits_tell_them_apart() -> None:
    different = [
        Fit(("rgb",), (), 1.0, "raw"),
        Fit(("rgb", "ms"), (), 1.0, "raw"),
        Fit(("rgb", "ms"), (("ms", 3),), 1.0, "raw"),
        Fit(("rgb", "ms"), (("rgb", 3),), 1.0, "raw"),
        Fit(("rgb", "ms"), (), 0.5, "raw"),
        Fit(("rgb", "ms"), (), 1.0, "demosaicked"),
        Fit(("rgb", "ms"), (), 1.0, "raw", prior=True),
    ]
    assert len({fit.name for fit in different}) == len(different)


def test_rays_of_a_step() -> None:
    """Equal rays of each modality in a fit of few and in one of all, where the number of modalities is given."""
    usual, one = Recipe(), Fit(("rgb",), (), 1.0, "raw")
    samples = usual.sampling.samples_per_step
    assert everything().recipe(usual, 5) == usual and one.recipe(usual, None) == usual
    assert one.recipe(usual, 5).sampling.samples_per_step == round(samples / 5)
    assert everything(rays=0.5).recipe(usual, 5).sampling.samples_per_step == samples // 2
    half = replace(one, rays=0.5).recipe(usual, None).sampling
    assert half.samples_per_step == samples // 2 and half.initial_rays == usual.sampling.initial_rays // 2


HEAD = "title = 't'\nsource = 's'\n[[row]]\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "title"),
        ("title = 't'\nsource = 's'", "row"),
        (HEAD + "name = 'a'\nwhy = 'b'", "row.0.why"),
        (HEAD + "name = 'a'\n[[row]]\nname = 'a'", "twice"),
        (HEAD + "name = 'a'\nrays = 0.0", "row.0.rays"),
        (HEAD + "name = 'a'\nframes = { all = 0 }", "row.0.frames.all"),
        (HEAD + "name = 'a'\nframes = { all = 1.5 }", "row.0.frames.all"),
        (HEAD + "name = 'a'\ninput = 'blurred'", "row.0.input"),
        (HEAD + "name = 'a'\nmodalities = []", "row.0.modalities"),
        (HEAD + "name = 'a'\nmodalities = ['each']", "{each}"),
        (HEAD + "name = 'a {each}'", "{each}"),
    ],
)
def test_bad_tables_are_refused_in_one_sentence(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "table.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load_experiments([str(path)])
    assert words in str(refused.value) and str(path) in str(refused.value) and "\n" not in str(refused.value)


def test_missing_tables_and_one_twice() -> None:
    with pytest.raises(InputError, match=r"'nonsense'.*few-frames, half"):
        load_experiments(["nonsense"])
    with pytest.raises(InputError, match="each once"):
        load_experiments(["half", "half"])
