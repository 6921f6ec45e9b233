"""Which views a fit does not learn from while directions are on trial, and what is drawn meanwhile."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.append(str(Path(__file__).parents[1] / "hard_cases"))
from small_scenes import around, write_scene

from mmsynth.field import kernels
from mmsynth.fitting.held_out import held_out_tiles, selections
from mmsynth.fitting.importance import Importance
from mmsynth.fitting.measurements import Measurements, draw, load_measurements
from mmsynth.scene.load import load_scene


def _measurements(folder: Path, **views: int) -> Measurements:
    return load_measurements(load_scene(write_scene(folder, {name: around(count) for name, count in views.items()})))


def _importance(measurements: Measurements) -> Importance:
    return Importance(measurements.chosen, measurements.modalities.first_tile, 0.5)


def _drawn(measurements: Measurements, selection: kernels.Selection) -> dict[str, set[int]]:
    """The views of each modality that 2,000 rays of it come from."""
    batch = draw(measurements, None, dict.fromkeys(measurements, 2000), np.random.default_rng(0), selection)
    views = np.concatenate([measurements[n].views for n in measurements.order])
    return {name: set(views[batch.frame[numbers].numpy()].tolist()) for name, (_, numbers) in batch.parts.items()}


@pytest.fixture(scope="module")
def measurements(tmp_path_factory: pytest.TempPathFactory) -> Measurements:
    return _measurements(tmp_path_factory.mktemp("scene"), rgb=20, nir=3)


def test_every_eighth_view_judges_and_the_others_are_learned_from(measurements: Measurements) -> None:
    held = held_out_tiles(measurements)
    assert held is not None
    where = _importance(measurements)
    learned, judged = selections(where, held)
    all_views = np.unique(measurements["rgb"].views)
    judges = set(all_views[4::8].tolist())
    assert len(judges) == 2
    assert _drawn(measurements, judged)["rgb"] == judges
    assert _drawn(measurements, learned)["rgb"] == set(all_views.tolist()) - judges
    where.residuals[held] = 9.0  # the worst of all
    where.renew(held)
    assert _drawn(measurements, where.selection)["rgb"] == set(all_views.tolist()) - judges
    where.renew()
    assert _drawn(measurements, where.selection)["rgb"] == set(all_views.tolist())


def test_a_modality_that_has_none_of_these_views_is_learned_from_and_judged_by_all_it_has(measurements: Measurements) -> None:
    every = set(measurements["nir"].views.tolist())
    assert 1 < len(every) < 4
    assert all(_drawn(measurements, some)["nir"] == every for some in selections(_importance(measurements), held_out_tiles(measurements)))


def test_few_views_are_all_learned_from(tmp_path: Path) -> None:
    measurements = _measurements(tmp_path, rgb=7)
    assert held_out_tiles(measurements) is None
    every = set(measurements["rgb"].views.tolist())
    assert all(_drawn(measurements, some)["rgb"] == every for some in selections(_importance(measurements), None))


def test_rays_that_decide_go_where_residuals_are_large_and_weigh_the_less(measurements: Measurements) -> None:
    held, where = held_out_tiles(measurements), _importance(measurements)
    assert held is not None
    worst = torch.arange(len(held)) % 4 == 0
    for residual in (1.0, 9.0):  # alike, and not
        where.residuals[worst] = residual
        for some in selections(where, held):
            batch = draw(measurements, None, {"rgb": 20_000}, np.random.default_rng(0), some)
            often, weight = float(worst[batch.tile].float().mean()), batch.ray_weight
            even = float((some.pixels * worst)[: len(some.ends)].sum() / some.pixels.sum())
            assert float(weight.mean()) == pytest.approx(1.0, abs=0.02)
            assert float(weight[worst[batch.tile]].sum() / weight.sum()) == pytest.approx(even, abs=0.02)
            assert often > 1.5 * even if residual > 1.0 else often == pytest.approx(even, abs=0.02)
