"""A whole step, fused, against its definition in float64."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from numba.core.runtime import _nrt_python, rtsys
from test_drawing import _scene, _selection
from torch import Tensor, nn

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import learning
from mmsynth.field.kernels.cpu import learning as fused
from mmsynth.field.kernels.cpu import tasks
from mmsynth.field.kernels.cpu.blocks import surface_weights
from mmsynth.field.light import Light
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.radiance import Shader
from mmsynth.field.rendering import interval
from mmsynth.field.surface import Surface
from mmsynth.scene.scene import Sensor
from mmsynth.threads import let_kernels_have

SENSORS = {
    "rgb": Sensor("rgb", ("R", "G", "B"), (None,) * 3),
    "pol": Sensor("pol", ("0", "45", "90", "135"), (None,) * 4, polarizer_angles_deg=(0.0, 45.0, 90.0, 135.0)),
}
RAYS = 300  # more than a chunk


def _step(
    extent: float, lamps: int, far: bool, gains: bool, opacities: bool, sparse: bool, extra: int = 0, seed: int = 0
) -> dict[str, Any]:
    """What a step takes, on an uneven ball; ``extra`` rays have no measurement."""
    torch.manual_seed(seed)
    surface, appearance = Surface(HashGrid(3, 10, 6, 24, extent), 8, (0.5, 1.7 if extent > 1 else 1e9)), HashGrid(3, 11, 8, 32, extent)
    nn.init.normal_(surface.grid.table, std=0.1)
    nn.init.normal_(surface.output_weight, std=0.15)
    nn.init.normal_(appearance.table)
    shader = Shader(appearance.width, 24, SENSORS, dict.fromkeys(SENSORS, 0.5))
    light = Light(appearance.width, shader.heads.out_features)
    if lamps:
        light.add(torch.tensor([[1.5, 2.0, -1.0], [-2.0, 0.5, 1.5], [0.0, -2.0, 2.0]])[:lamps])
        nn.init.normal_(light.log_spectrum, std=0.3)
        nn.init.normal_(light.second.weight, std=0.3)
        light.used[1 if lamps > 2 else 0] = lamps <= 2  # used lamps need not be the first
    occupancy = Occupancy(24, extent)
    occupancy.update(lambda x: surface(x, 3), 30.0)
    count = RAYS + extra
    origins = nn.functional.normalize(torch.randn(count, 3), dim=1) * 1.6
    directions = nn.functional.normalize(0.35 * torch.randn(count, 3) - origins, dim=1)
    near, far_end = interval(surface, origins, directions)
    polarized = RAYS // 3
    ray = torch.cat([torch.arange(RAYS - polarized).repeat_interleave(3), torch.arange(RAYS - polarized, RAYS)])
    output = torch.cat([torch.arange(3).repeat(RAYS - polarized), torch.full((polarized,), 3)])
    axes = nn.functional.normalize(torch.randn(polarized, 3), dim=1)
    numbers = len(ray)
    measured = kernels.Measured(
        torch.rand(numbers), ray, output, axes, torch.full((numbers,), 0.5), torch.full((numbers,), 0.9), torch.rand(numbers) / numbers
    )
    frames = torch.nn.Parameter(0.2 * torch.randn(5) if gains else torch.empty(0))
    return {
        "surface": surface,
        "appearance": appearance,
        "shader": shader,
        "light": light,
        "far_light": nn.Parameter(torch.randn(appearance.width) if far else torch.empty(0)),
        "states": occupancy.states,
        "rays": kernels.Rays(origins, directions, near, far_end, torch.rand(count)),
        "view": kernels.View(torch.randint(4, (count,)), torch.rand(count) > 0.3 if sparse else torch.ones(count, dtype=torch.bool)),
        "measured": measured,
        "gains": kernels.Gains(frames, torch.randint(5, (numbers,))),
        "opacities": kernels.Opacities(*(torch.rand(4, count) / count if opacities else torch.empty(4, 0)), 0.05),
        "eikonal": kernels.Eikonal(
            (torch.rand(100, 3) * 2 - 1) * extent, torch.empty(0, 3) if lamps else 0.05 * torch.randn(120, 3), 0.1, 0.08, 0.16, 0.3
        ),
        "smooth": kernels.Smooth(0.1 * torch.randn(30, 3), 0.1, 0.05),
        "sampling": kernels.Sampling(30.0, 2 / 30, 3, 3),
        "roulette": 0.0,
    }


def _told(step: dict[str, Any], dtype: torch.dtype, active: int = 3) -> tuple[kernels.Step, dict[str, nn.Parameter]]:
    """A step as kernels take it, of so many levels of three, and all that is learned by name."""
    modules = {n: m.to(dtype) for n, m in step.items() if isinstance(m, nn.Module)}
    for m in modules.values():
        m.zero_grad()
    cast = lambda x: x.to(dtype) if isinstance(x, Tensor) and x.is_floating_point() else x
    tuples = {n: type(x)(*map(cast, x)) for n, x in step.items() if isinstance(x, tuple)}
    far_light, log_gain = (nn.Parameter(x.detach().to(dtype)) for x in (step["far_light"], step["gains"].log_gain))
    grid, network = modules["surface"].at(active)
    told = kernels.Step(
        grid, network, modules["appearance"].at(active), step["states"], modules["shader"].weights(), modules["light"].network(), far_light,
        tuples["rays"], tuples["view"], tuples["measured"], tuples["gains"]._replace(log_gain=log_gain), tuples["opacities"],
        tuples["eikonal"], tuples["smooth"], step["sampling"], step["roulette"],
    )  # fmt: skip
    return told, {f"{n}.{k}": p for n, m in modules.items() for k, p in m.named_parameters()} | {"far": far_light, "gain": log_gain}


def _run(step: dict[str, Any], dtype: torch.dtype, *ahead: Sequence[kernels.Drawing]) -> tuple[kernels.Learned, dict[str, Tensor]]:
    """What was learned, and all gradients by name."""
    told, parameters = _told(step, dtype)
    found = kernels.learn(kernels.arrange(told, *ahead)) if dtype == torch.float32 or ahead else learning.learn(told)
    return found, {n: p.grad.clone() for n, p in parameters.items() if p.grad is not None and p.numel()}


CASES = {
    "plain": (1.0, 0, False, False, False, False),
    "background": (2.0, 0, False, True, False, False),
    "lamps and background": (2.0, 2, False, True, False, True),
    "far light": (1.0, 0, True, False, True, False),
    "lamps": (1.0, 2, False, False, False, False),
    "all": (1.0, 3, True, True, True, True),
}


@pytest.mark.parametrize("case", CASES)
def test_a_step_is_that_of_the_definition(case: str) -> None:
    step = _step(*CASES[case], extra=70 if case == "far light" else 0)
    truth, expected = _run(step, torch.float64)
    found, gradients = _run(step, torch.float32)
    assert abs(found.loss.item() - truth.loss.item()) < 2e-5 * truth.loss.item()
    alone, _ = _run(step | {"smooth": step["smooth"]._replace(weight=0.0)}, torch.float32)
    assert (found.loss > alone.loss) == (step["surface"].grid.extent > 1.0)  # what is outside of the ball has neighbours
    assert abs(int(found.samples) - int(truth.samples)) <= 2  # a step may round to the other side of a cell's face
    assert set(expected) == set(gradients)
    for learned, of_all in ((found, gradients), (truth, expected)):
        of_weights = [g.double() for name, g in of_all.items() if not name.endswith(".table")]
        assert abs(learned.gradients - sum(g.sum() for g in of_weights)) < 1e-5 * sum(g.abs().sum() for g in of_weights)
    for name, g in expected.items():
        off = (gradients[name].double() - g).abs().max() / g.abs().max().clamp(min=1e-12)
        assert off < 5e-3, (name, off)
    assert all(g.abs().max() > 0 for n, g in expected.items()), [n for n, g in expected.items() if not g.abs().max() > 0]


_PLAYED = ("surface.", "appearance.")  # whose gradients may be estimates


@pytest.mark.parametrize(("case", "eikonal"), [("background", 0.1), ("all", 0.1), ("background", 100.0), ("all", 100.0)])
def test_with_roulette_gradients_are_right_in_the_mean(case: str, eikonal: float) -> None:
    """Of the surface and the appearance; all others are the same to the bit. With a strong pull the surface's are of taps, nearly all."""
    along: dict[str, list[float]] = {}
    for seed in range(40):
        step = _step(*CASES[case], seed=seed)
        step["eikonal"] = step["eikonal"]._replace(weight=eikonal)
        (exact, expected), (found, gradients) = _run(step, torch.float32), _run(step | {"roulette": 0.5}, torch.float32)
        assert found.loss == exact.loss and torch.equal(found.squared, exact.squared)
        for name, g in expected.items():
            if not name.startswith(_PLAYED):
                assert torch.equal(gradients[name], g), name
                continue
            off, size = (gradients[name] - g).double(), g.double().square().sum()
            along.setdefault(name, []).append(((off * g).sum() / size).item())
            assert 0 < off.square().sum() < 0.3 * size, name
    for name, parts in along.items():
        mean, unsure = np.mean(parts), np.std(parts) / len(parts) ** 0.5
        assert abs(mean) < 4 * unsure and unsure < 0.02, (name, mean, unsure)


@pytest.mark.parametrize("roulette", [0.0, 0.3])
def test_sums_do_not_depend_on_threads(roulette: float, use_threads: Callable[[int], None]) -> None:
    step, results = _step(*CASES["all"]) | {"roulette": roulette}, []
    for threads in (1, 2, 5):
        use_threads(threads)
        results.append(_run(step, torch.float32))
    for learned, gradients in results[1:]:
        assert learned.loss == results[0][0].loss
        assert all(torch.equal(g, gradients[n]) for n, g in results[0][1].items())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_rays_of_the_next_step_are_drawn_beside_it(dtype: torch.dtype, count: int) -> None:
    """The same rays as alone, and the step is the same."""
    step, tables = _step(*CASES["lamps"]), _scene()
    asked = [([500, 300, 200], (7, 8)), ([100, 0, 65], (2**32 - 1, 9))][:count]
    drawings = [kernels.Drawing(*tables, _selection(n, 0.3)[0], rays, key) for n, (rays, key) in enumerate(asked)]
    (alone, expected), (found, gradients) = _run(step, dtype), _run(step, dtype, drawings)
    assert found.loss == alone.loss and torch.equal(found.squared, alone.squared)
    assert all(torch.equal(g, expected[n]) for n, g in gradients.items())
    assert len(found.drawn) == count
    for ours, drawing in zip(found.drawn, drawings, strict=True):
        theirs = kernels.draw(*drawing)
        for one, other in zip((*ours[:-1], *ours.measured), (*theirs[:-1], *theirs.measured), strict=True):
            assert torch.equal(one.nan_to_num(-1.0), other.nan_to_num(-1.0))


def _parts(parameters: dict[str, nn.Parameter]) -> list[kernels.AdamPart]:
    """A third step of Adam, of which tables are sparse."""
    torch.manual_seed(2)
    rates = {n: 0.01 * (k + 1) for k, n in enumerate(parameters)}
    steps = {n: kernels.AdamStep(rate, 0.9, 0.99, 1e-15, 3, n.endswith(".table")) for n, rate in rates.items()}
    moments = {n: (torch.randn_like(p), torch.rand_like(p)) for n, p in parameters.items()}
    return [kernels.AdamPart(p, learning.gradient_of(p), *moments[n], steps[n]) for n, p in parameters.items()]


def _with_update(step: dict[str, Any], dtype: torch.dtype, active: int = 3) -> tuple[kernels.Learned, list[Tensor], list[Any]]:
    """What was learned, parameters, gradients and moments after it, and what was told meanwhile."""
    told, parameters = _told(step, dtype, active)
    parts, heard = _parts(parameters), list[Any]()
    found = kernels.learn(
        kernels.arrange(told), lambda: parts, lambda learned: heard.append((learned.loss.clone(), learned.squared.clone()))
    )
    return found, [x.detach().clone() for part in parts for x in part[:4]], heard


def _check_update(case: str, active: int) -> None:
    """The same to the bit as Adam by itself of whole tables after it."""
    told, parameters = _told(_step(*CASES[case]), torch.float32, active)
    alone, parts = kernels.learn(kernels.arrange(told)), _parts(parameters)
    moved = [bool(part.gradient.any()) for part in parts]
    with torch.no_grad():
        for part in parts:
            kernels.adam(*part)
    found, after, heard = _with_update(_step(*CASES[case]), torch.float32, active)
    assert found.loss == alone.loss and found.gradients == alone.gradients and sum(moved) > 8
    assert all(torch.equal(x, y) for x, y in zip(after, (x.detach() for part in parts for x in part[:4]), strict=True))
    assert not any(x.any() for x in after[1::4])
    ((loss, squared),) = heard
    assert loss == alone.loss and torch.equal(squared, alone.squared)


@pytest.mark.parametrize("threads", [1, 2, 4])
@pytest.mark.parametrize("active", [1, 3])
@pytest.mark.parametrize("case", ["all", "plain"])
def test_a_step_of_adam_comes_with_it(case: str, active: int, threads: int, use_threads: Callable[[int], None]) -> None:
    use_threads(threads)
    _check_update(case, active)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("what", ["the loss", "a gradient"])
def test_nothing_moves_by_what_is_not_finite(what: str, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    step = _step(*CASES["all"])
    if what == "the loss":
        step["measured"].target[5] = torch.nan
        before = [p.detach().clone() for p in _told(step, dtype)[1].values()]
    else:
        before = [p.detach().clone() for p in _told(step, dtype)[1].values()]
        monkeypatch.setattr(learning, "gradient_of", lambda p, known=learning.gradient_of: known(p).fill_(torch.nan))
    found, after, heard = _with_update(step, dtype)
    assert torch.isfinite(found.loss) == (what == "a gradient") and not torch.isfinite(found.gradients)
    assert all(torch.equal(x, y) for x, y in zip(after[::4], before, strict=True))
    assert any(torch.isnan(g).any() for g in after[1::4]) and len(heard) == 1


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_what_fails_beside_the_kernels_is_raised(threads: int, use_threads: Callable[[int], None]) -> None:
    use_threads(threads)
    told, _ = _told(_step(*CASES["plain"]), torch.float32)

    def fails(*_: Any) -> Any:
        raise LookupError("beside")

    for arguments in ((fails, None), (None, fails)):
        with pytest.raises(LookupError, match="beside"):
            kernels.learn(kernels.arrange(told), *arguments)
    assert torch.isfinite(kernels.learn(kernels.arrange(told)).loss)


@pytest.mark.parametrize("case", ["plain", "background", "far light", "lamps and background"])
def test_kernels_of_a_step_ask_for_no_memory(case: str, monkeypatch: pytest.MonkeyPatch, use_threads: Callable[[int], None]) -> None:
    use_threads(1)
    _nrt_python.memsys_enable_stats()
    counted: dict[str, tuple[int, int]] = {}

    def counting(kernel: Callable[..., None]) -> Callable[..., None]:
        def call(*arguments: Any) -> None:
            before = rtsys.get_allocation_stats()
            kernel(*arguments)
            after = rtsys.get_allocation_stats()
            counted[kernel.__name__] = after.mi_alloc - before.mi_alloc, after.mi_free - before.mi_free

        return call

    for kernel in (fused.learn_rays, fused.finish):
        monkeypatch.setattr(fused, kernel.__name__, counting(kernel))
    assert torch.isfinite(_with_update(_step(*CASES[case]), torch.float32)[0].loss)
    assert counted == {"learn_rays": (0, 0), "finish": (0, 0)}
    counting(surface_weights)(np.zeros((4, 8), np.float32), np.zeros(5, np.float32))
    assert counted["surface_weights"][0] > 0  # what allocates is counted


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_so_many_threads_take_tasks_at_once(threads: int) -> None:
    """And a kernel that fails in one of them is heard of."""
    all_there = threading.Barrier(threads)
    assert tasks.take_beside(lambda: "meanwhile", threads, lambda seconds: all_there.wait(seconds), (60,)) == "meanwhile"

    def fails_in_the_last(_: int) -> None:
        if all_there.wait(60) == threads - 1:
            raise MemoryError("in one thread")

    for _ in range(4):
        with pytest.raises(MemoryError, match="in one thread"):
            tasks.take_beside(lambda: None, threads, fails_in_the_last, (0,))


def test_what_is_done_beside_a_kernel_may_call_kernels() -> None:
    """The pool's only thread is the one that calls them: nobody waits for what it would have to begin."""
    begun, at = threading.Event(), threading.current_thread

    def call() -> tuple[threading.Thread, threading.Thread]:
        begun.set()
        return at(), tasks.take_beside(at, 2, lambda: None, ())

    outer, inner = tasks.take_beside(call, 2, lambda: begun.wait(60), ())
    assert outer is inner is not at()


def test_kernels_that_several_threads_call_at_once_give_what_one_gives() -> None:
    selection, _ = _selection(3, 0.5)
    expected = kernels.draw(*_scene(), selection, [999, 333, 111], (4, 5))

    def draw(_: int) -> bool:
        let_kernels_have(2)
        found = kernels.draw(*_scene(), selection, [999, 333, 111], (4, 5))
        return torch.equal(found.tile, expected.tile) and torch.equal(found.directions, expected.directions)

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(draw, range(40)))


def test_far_light_is_what_a_ray_without_surface_shows() -> None:
    hits = kernels.Hits(
        torch.zeros(1, 4),
        torch.zeros(1),
        torch.zeros(1),
        torch.full((1,), -1),
        torch.zeros(1),
        torch.full((1,), torch.nan),
        torch.tensor(0),
    )
    shaded = learning.with_far_light(hits, torch.ones(4))
    assert torch.equal(shaded.features, torch.ones(1, 4)) and shaded.share.item() == 1.0
