"""The tests that residuals are put to, on residuals that are known."""

import numpy as np
import pytest
import torch

from mmsynth.field import kernels
from mmsynth.field.radiance import Shader
from mmsynth.fitting.candidates import Look
from mmsynth.fitting.decisions import choose_degrees, degree_needed, errors_by_degree, exposure_spread
from mmsynth.fitting.measurements import Batch
from mmsynth.fitting.needs import DEGREES
from mmsynth.scene.scene import Sensor


def _frames(gains: np.ndarray, noise: float, per_frame: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Predicted, target, weight and frame."""
    random = np.random.default_rng(0)
    frame = np.repeat(np.arange(len(gains)), per_frame)
    predicted = random.uniform(0.3, 1.5, len(frame))
    return predicted, gains[frame] * predicted + noise * random.normal(size=len(frame)), np.ones(len(frame)), frame


@pytest.mark.parametrize("spread", [0.03, 0.1, 0.3])
def test_spread_of_exposure_is_found(spread: float) -> None:
    gains = np.exp(spread * np.random.default_rng(1).normal(size=200))
    found, error = exposure_spread(*_frames(gains, noise=0.1))
    assert found == pytest.approx(spread, rel=0.2)
    assert 0.003 < error < 0.01  # 0.1 of noise over 400 numbers of about 1


def test_noise_alone_is_no_exposure() -> None:
    found, error = exposure_spread(*_frames(np.ones(200), noise=0.3))
    assert found < error
    assert exposure_spread(*_frames(np.ones(1), noise=0.1)) == (0.0, 0.0)


def test_one_odd_frame_is_no_exposure() -> None:
    gains = np.ones(40)
    gains[7] = 3.0
    found, _ = exposure_spread(*_frames(gains, noise=0.02))
    assert found < 0.01


def test_what_is_drawn_more_often_counts_the_less() -> None:
    """Half of each frame is another thing, wrong in some frames, and drawn nine times as often as the rest."""
    predicted, target, _, frame = _frames(np.ones(200), noise=0.02)
    odd = np.arange(len(frame)) % 10 > 0
    target = np.where(odd, predicted * np.where(frame % 2, 1.2, 1.0), target)
    (even, _), (weighted, _) = (exposure_spread(predicted, target, w, frame) for w in (np.ones(len(frame)), np.where(odd, 1 / 9, 1.0)))
    gains = np.log(1 + 0.2 * np.array([0.9, 0.5]))  # of the wrong frames
    assert even == pytest.approx(1.4826 * gains[0] / 2, rel=0.1) and weighted == pytest.approx(1.4826 * gains[1] / 2, rel=0.1)


def _seen(rays: int, harmonic: int, strength: float = 0.5, noise: float = 0.05) -> Look:
    """Rays of one grey modality whose light depends on a harmonic of the direction of this degree, on nothing else, and has noise."""
    directions = torch.nn.functional.normalize(torch.randn(rays, 3), dim=1)
    x, y, _ = directions.unbind(1)
    ones, every = torch.ones(rays), torch.arange(rays)
    light = 1.0 + strength * {0: 0 * x, 1: x, 3: x * (x * x - 3 * y * y)}[harmonic] + noise * torch.randn(rays)
    batch = Batch(
        origins=torch.zeros(rays, 3), directions=directions, frame=0 * every,
        measured=kernels.Measured(light, every, 0 * every, torch.empty(0, 3), ones, 9 * ones, ones / rays),
        parts={"grey": (slice(0, rays), slice(0, rays))}, alpha=ones * float("nan"), ray_weight=ones, jitter=0 * ones, tile=0 * every,
    )  # fmt: skip
    hits = kernels.Hits(torch.zeros(rays, 2), ones, ones, torch.full((rays,), -1), ones, ones, torch.tensor(0))
    return Look(batch, hits, torch.zeros(rays))


def _taught(look: Look) -> Shader:
    """A shader that has learned a look, with all directions."""
    shader = Shader(2, 32, {"grey": Sensor("grey", ("L",), (550.0,))}, {"grey": 1.0})
    m, hits, teacher = look.batch.measured, look.hits, torch.optim.Adam(shader.parameters(), lr=8e-3)
    for _ in range(150):
        teacher.zero_grad()
        outputs = shader(hits.features, look.batch.directions, DEGREES)
        kernels.photometric(kernels.predict(outputs, hits.share, m) - m.target, m).backward()
        teacher.step()
    return shader


@pytest.mark.parametrize("needed", [0, 1, 3])
def test_the_degree_that_light_has_is_found(needed: int) -> None:
    """A shader that was taught it with all directions."""
    torch.manual_seed(0)
    learned, judged = _seen(2048, needed), _seen(2048, needed)
    shader = _taught(learned)
    before = [p.detach().clone() for p in shader.parameters()]
    errors = errors_by_degree(shader, DEGREES, [learned], [judged])["grey"]
    assert len(errors) == DEGREES + 1
    assert degree_needed(errors, worth=0.1) == needed, errors
    assert all(bool((p == q).all()) for p, q in zip(shader.parameters(), before, strict=True))  # copies learned, not the shader


def test_a_degree_does_not_hang_on_the_few_rays_that_were_drawn() -> None:
    """Light of which directions explain a tenth: from one look of some rays the degree is another each time, from many it is that of the
    light. So decided fits of one scene, by their seed, and those without directions had 0.4 dB less."""
    torch.manual_seed(0)
    seen = lambda rays: _seen(rays, 1, 0.3, 0.5)
    shader = _taught(seen(8192))
    degrees = lambda looks: [
        degree_needed(errors_by_degree(shader, DEGREES, *[[seen(n) for _ in range(looks)] for n in (128, 256)])["grey"], 0.03)
        for _ in range(8)
    ]
    assert len(set(degrees(1))) > 1 and set(degrees(64)) == {1}


def _errors(*means: float, numbers: int = 2000, noise: float = 0.0) -> torch.Tensor:
    """(4, numbers), with these means; those of lower degrees differ from the last ones' by as much noise at each number."""
    last = torch.full((numbers,), means[-1])
    return torch.stack([last + (m - means[-1]) + noise * torch.randn(numbers) * (m != means[-1]) for m in means])


def test_a_noisy_sensor_sees_the_same_scene_as_the_others() -> None:
    torch.manual_seed(0)
    clear, unclear, flat, none = (
        _errors(2.0, 1.9, 1.5, 1.0),
        _errors(1.3, 1.2, 1.04, 1.0),
        _errors(1.0, 1.01, 1.02, 1.02),
        torch.empty(4, 0),
    )
    degrees = lambda **errors: {name: choice.value for name, choice in choose_degrees(errors, worth=0.05).items()}
    assert degrees(pol=unclear) == {"pol": 2}
    assert degrees(rgb=clear, ms=clear, pol=unclear, nir=none) == {"rgb": 3, "ms": 3, "pol": 3, "nir": 3}
    assert degrees(rgb=flat, ms=flat, pol=_errors(1.2, 1.1, 1.0, 1.01)) == {"rgb": 1, "ms": 1, "pol": 2}
    assert degrees(rgb=flat) == {"rgb": 0} and degrees(rgb=none) == {"rgb": 0}


def test_degree_needed_is_the_lowest_of_the_good_ones() -> None:
    assert degree_needed(_errors(1.05, 1.02, 1.0, 1.01), worth=0.1) == 0
    assert degree_needed(_errors(2.0, 1.05, 1.0, 1.01), worth=0.1) == 1
    assert degree_needed(_errors(2.0, 1.9, 1.5, 1.0), worth=0.1) == 3


def test_a_difference_that_chance_makes_needs_no_degree() -> None:
    torch.manual_seed(1)
    few, many = (_errors(1.2, 1.2, 1.2, 1.0, numbers=n, noise=4.0) for n in (200, 200_000))
    assert degree_needed(few, worth=0.05) == 0  # 0.2 +- 0.28
    assert degree_needed(many, worth=0.05) == 3  # 0.2 +- 0.01
