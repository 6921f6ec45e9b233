"""Shading and its loss: the fused CPU kernel in float32 against the same thing from single operations in float64.

Tolerances are relative to the largest value of each quantity, and a few times what float32 leaves of it.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from mmsynth.field import kernels
from mmsynth.field.kernels import Measured, ShadedRays, cpu, reference
from mmsynth.field.kernels.cpu import shading as cpu_shading
from mmsynth.field.kernels.cpu import stores
from mmsynth.field.radiance import Shader
from mmsynth.fitting.measurements import Batch
from mmsynth.scene.scene import Sensor
from mmsynth.threads import kernel_threads

Modality = tuple[str, int, float, float]  # name, numbers per ray, level, saturation
MOSAIC, FILM, TENSOR, ANALYSERS = (
    ("mosaic", 1, 0.2, 0.25),
    ("film", 4, 3.0, 4.0),
    ("tensor", 1, 0.5, 0.9),
    ("analysers", 3, 1.0, float("inf")),
)
ALL = MOSAIC, FILM, TENSOR, ANALYSERS
SENSORS = {
    "mosaic": Sensor("mosaic", ("R", "G", "B"), (None,) * 3, np.array([[1, 2], [0, 1]])),
    "film": Sensor("film", ("a", "b", "c", "d"), (None,) * 4),
    "tensor": Sensor("tensor", ("0", "45", "90", "135"), (None,) * 4, np.array([[2, 1], [3, 0]]), (0.0, 45.0, 90.0, 135.0)),
    "analysers": Sensor("analysers", ("0", "60", "120"), (None,) * 3, None, (0.0, 60.0, 120.0)),
}
LEVELS = {name: level for name, _, level, _ in ALL}


@dataclasses.dataclass
class Case:
    """What is compared with what; degrees of directions, and rays that teach, are mixed."""

    shader: Shader
    features: torch.Tensor
    share: torch.Tensor
    behind: torch.Tensor
    batch: Batch
    degrees: torch.Tensor
    trains_geometry: torch.Tensor
    gain: torch.Tensor | None

    def double(self) -> Case:
        """The same in float64."""

        def exact(x: Any) -> Any:
            if isinstance(x, torch.Tensor):
                return x.detach().double() if x.is_floating_point() else x
            if isinstance(x, torch.nn.Module):
                return copy.deepcopy(x).double()
            if isinstance(x, Measured):
                return Measured(*map(exact, x))
            return dataclasses.replace(x, **{k: exact(v) for k, v in vars(x).items()}) if dataclasses.is_dataclass(x) else x

        return exact(self)


def _case(count: int, modalities: tuple[Modality, ...] = ALL, width: int = 24, hidden: int = 64, gains: bool = True) -> Case:
    """``count`` rays of each modality; a fifth of them miss everything."""
    torch.manual_seed(count)
    shader = Shader(width, hidden, SENSORS, LEVELS)
    with torch.no_grad():
        shader.heads.weight.mul_(8)  # dark and bright
    rays = count * len(modalities)
    parts: dict[str, tuple[slice, slice]] = {}
    lists: dict[str, list[torch.Tensor]] = {k: [] for k in ("target", "ray", "output", "level", "saturation", "weight")}
    axes = []
    for name, values, level, saturation in modalities:
        numbers, begin = count * values, len(parts) * count
        done = sum(len(x) for x in lists["ray"])
        parts[name] = slice(begin, begin + count), slice(done, done + numbers)
        columns = shader.columns[name]
        lists["ray"].append(torch.arange(begin, begin + count).repeat_interleave(values))
        if SENSORS[name].is_polarization:
            lists["output"].append(torch.full((numbers,), columns.start))
            axes.append(normalize(torch.randn(numbers, 3), dim=1))
        elif values == 1:
            lists["output"].append(torch.randint(columns.start, columns.stop, (numbers,)))
        else:
            lists["output"].append(torch.arange(columns.start, columns.stop).repeat(count))
        lists["target"].append((2 * level * torch.rand(numbers)).clamp(max=saturation))
        for key, value in (("level", level), ("saturation", saturation), ("weight", 1.0 / max(len(modalities) * numbers, 1))):
            lists[key].append(torch.full((numbers,), value))
    joined = {k: torch.cat(v) for k, v in lists.items()}
    frame, alpha = torch.zeros_like(joined["ray"]), torch.full((rays,), torch.nan)
    directions = normalize(torch.randn(rays, 3), dim=1)
    twice = torch.nonzero(torch.rand(rays) < 0.3)[:, 0]
    behind = torch.full((rays,), -1)
    behind[twice] = torch.arange(rays, rays + len(twice))
    share = torch.rand(rays + len(twice))
    share[:rays][torch.rand(rays) < 0.2] = 0.0
    batch = Batch(
        origins=torch.zeros(rays, 3), directions=directions, jitter=torch.zeros(rays), frame=frame, parts=parts, alpha=alpha,
        ray_weight=torch.ones(rays), tile=torch.zeros(rays, dtype=torch.int64),
        measured=Measured(**joined, axes=torch.cat(axes) if axes else torch.empty(0, 3)),
    )  # fmt: skip
    gain = torch.rand(len(joined["ray"])) + 0.5 if gains else None
    return Case(shader, torch.randn(len(share), width), share, behind, batch, torch.randint(4, (rays,)), torch.rand(rays) < 0.8, gain)


def _quantities(case: Case) -> dict[str, torch.Tensor]:
    """Loss, squared residuals, and gradients of three times the loss."""
    inputs = {name: x for name in ("features", "share", "gain") if (x := getattr(case, name)) is not None}
    for x in (*inputs.values(), *case.shader.parameters()):
        x.requires_grad_().grad = None
    loss, squared = _compare(case)
    assert loss.shape == () and squared.shape == case.batch.measured.target.shape and not squared.requires_grad
    (3.0 * loss).backward()
    gradients = {name: x.grad for name, x in (*inputs.items(), *case.shader.named_parameters())}
    return {"loss": loss.detach(), "squared": squared, **{f"gradient of {n}": g for n, g in gradients.items()}}


def _compare(case: Case) -> tuple[torch.Tensor, torch.Tensor]:
    rays = ShadedRays(case.features, case.share, case.behind, case.batch.directions, case.degrees, case.trains_geometry)
    return kernels.compare(case.shader.weights(), rays, case.batch.measured, case.gain)


def _check(case: Case) -> dict[str, torch.Tensor]:
    """Within 3e-6 of the largest of each quantity: from single operations in float32 it is within 2e-6."""
    found, expected = _quantities(case), _quantities(case.double())
    assert list(found) == list(expected)
    for name, value in found.items():
        exact = expected[name]
        assert value.dtype == torch.float32 and exact.dtype == torch.float64 and value.shape == exact.shape, name
        assert torch.isfinite(value).all(), name
        if exact.numel():
            worst = float((value - exact).abs().max() / exact.abs().max().clamp(min=1e-30))
            assert worst < 3e-6, f"{name}: apart by {worst:.1e} of the largest"
    return found


@pytest.mark.parametrize("count", [1, 15, 16, 17, 300])  # of each of four modalities: parts of chunks
def test_compare(count: int) -> None:
    case = _case(count)
    found = _check(case)
    if count == 300:
        clipped = case.batch.measured.target >= case.batch.measured.saturation
        assert 0.1 < clipped.float().mean() < 0.5 and (found["squared"][clipped] == 0).any()
        assert (found["squared"].sqrt() > 0.5 * case.batch.measured.level).any()  # the linear part of the loss, too
        for name in ("features", "share"):
            assert (
                not found[f"gradient of {name}"][~case.trains_geometry[kernels.rays_of(case.behind, len(case.share))]].any()
                and found[f"gradient of {name}"].any()
            )


@pytest.mark.parametrize("modalities", [(FILM,), (TENSOR,), (MOSAIC, FILM), (ANALYSERS, TENSOR)])
@pytest.mark.parametrize("gains", [False, True])
def test_compare_some_modalities(modalities: tuple[Modality, ...], gains: bool) -> None:
    _check(_case(150, modalities, gains=gains))


@pytest.mark.parametrize(("width", "hidden"), [(4, 4), (16, 20), (28, 96), (33, 33)])
def test_compare_with_layers_of_parts_of_tiles(width: int, hidden: int) -> None:
    _check(_case(50, width=width, hidden=hidden))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compare_with_one_degree(degree: int) -> None:
    case = _case(50)
    case.degrees[:] = degree
    _check(case)


def test_float32_is_fused_and_float64_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    case = _case(10)
    monkeypatch.setattr(reference, "compare", None)
    _quantities(case)
    monkeypatch.undo()
    monkeypatch.setattr(cpu, "compare", None)
    _quantities(case.double())


def test_scarce_rays_teach_the_heads_alone() -> None:
    case = _case(50)
    case.trains_geometry[:] = False
    found = _check(case)
    taught = {name for name, value in found.items() if value.any()}
    assert taught == {"loss", "squared", "gradient of gain", "gradient of heads.weight", "gradient of heads.bias"}


@pytest.mark.parametrize("raw", [90.0, 1e4, -90.0, -1e4])
def test_outputs_far_from_zero(raw: float) -> None:
    """exp would overflow, or leave nothing."""
    case = _case(50, gains=False)
    with torch.no_grad():
        case.shader.heads.bias.fill_(raw)
    _check(case)


def test_rays_that_miss_everything() -> None:
    case = _case(50)
    case.share[:] = 0.0
    found = _check(case)
    assert found["gradient of share"].any() and not found["gradient of features"].any()


def test_clipped_pixels_that_are_bright_enough_ask_for_nothing() -> None:
    case = _case(50)
    case.batch.measured.saturation[:] = 0.0
    case.batch.measured.target[:] = 0.0
    found = _check(case)
    assert not any(value.any() for value in found.values())


def test_what_is_not_a_number_is_seen_in_the_loss() -> None:
    for name, value in (("features", torch.nan), ("share", torch.nan), ("gain", torch.nan), ("features", torch.inf)):
        case = _case(50)
        getattr(case, name)[70] = value
        assert not torch.isfinite(_compare(case)[0]), name
    for index, (name, _) in enumerate(case.shader.named_parameters()):
        case = _case(50)
        with torch.no_grad():
            list(case.shader.parameters())[index][1] = torch.nan
        assert not torch.isfinite(_compare(case)[0]), name


def test_no_rays() -> None:
    found = _quantities(_case(0))
    assert float(found["loss"]) == 0.0 and not any(value.any() for value in found.values())


def test_a_loss_is_the_same_without_a_gradient() -> None:
    case = _case(100)
    expected = _quantities(case)
    with torch.no_grad():
        first = _compare(case)
    case.shader.requires_grad_(False)
    second = _compare(dataclasses.replace(case, features=case.features.detach(), share=case.share.detach(), gain=case.gain.detach()))
    for loss, squared in (first, second):
        assert not loss.requires_grad
        assert torch.equal(loss, expected["loss"]) and torch.equal(squared, expected["squared"])


def test_no_room_is_made_for_gradients_that_nobody_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Deciding about lamps compares 20,480 rays, 40 tasks, each with gradients of all weights."""
    slots, store, case = [], stores.Store, _case(2500)
    monkeypatch.setattr(stores, "Store", lambda n, kind, sizes: slots.append(n) or store(n, kind, sizes))
    with torch.no_grad():
        _compare(case)
    _compare(case)
    assert slots == [kernel_threads(), -(-len(case.behind) // (cpu_shading.TOGETHER * cpu_shading.CHUNK))]


def test_losses_do_not_share_what_they_keep() -> None:
    """Two forward passes before their backward passes, features of another layout, frozen weights."""
    cases = [_case(60), _case(90)]
    expected = [_quantities(case)["gradient of features"] for case in cases]
    kept = []
    for case in cases:
        case.shader.requires_grad_(False)
        case.features = case.features.detach().T.contiguous().T.requires_grad_()
        kept.append(_compare(case)[0])
    for case, loss, gradient in zip(cases, kept, expected, strict=True):
        (3.0 * loss).backward()
        assert torch.equal(case.features.grad, gradient)
        assert all(p.grad is not None for p in case.shader.parameters())  # of _quantities, and no new one


def test_results_do_not_depend_on_the_number_of_threads(use_threads: Callable[[int], None]) -> None:
    case, results = _case(400), []
    assert len(case.features) > 4 * cpu_shading.CHUNK
    for count in (1, 2, 5):
        use_threads(count)
        results.append({name: value.clone() for name, value in _quantities(case).items()})
    for other in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(value, other[name]), name
