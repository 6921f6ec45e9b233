"""Virtual channels against closed forms, least squares, and random spectra that are drawn without the code."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import gamma, kv

from mmsynth.errors import InputError
from mmsynth.sensors.sensor_file import Response
from mmsynth.sensors.spectral import MEASURED_ERROR, RESIDUAL_LIMIT, SMOOTH_NM, combine, require_expressible

NM = tuple(np.arange(400.0, 721.0, 10.0).tolist())
RGB = tuple(Response(centre_nm=c, fwhm_nm=w, peak=p) for c, w, p in ((600.0, 75.0, 0.9), (535.0, 90.0, 1.0), (460.0, 85.0, 0.85)))
BANDS = tuple(Response(centre_nm=c, fwhm_nm=40.0) for c in (431.0, 464.0, 503.0, 541.0, 572.0, 611.0, 653.0, 692.0))


def _table(values: np.ndarray) -> Response:
    return Response(nm=NM, value=tuple(values.tolist()))


def _tables(count: int) -> tuple[Response, ...]:
    """Measured channels as tables on one grid, so that a combination of them is a table on it, too."""
    centres = np.linspace(440, 680, count)
    return tuple(_table(np.exp(-((np.array(NM) - c) ** 2) / (2 * (140.0 / count) ** 2)) + 0.01) for c in centres)


def _matern(nm: np.ndarray, order: float = 1.5) -> np.ndarray:
    """The covariance in its general form, by Bessel functions (Rasmussen and Williams 2006, 4.14)."""
    d = np.abs(nm[:, None] - nm) + 1e-9
    x = math.sqrt(2 * order) * d / SMOOTH_NM
    return np.asarray(2 ** (1 - order) / gamma(order) * x**order * kv(order, x))


def _rms(response: Response, nm: np.ndarray) -> float:
    """Of the channel's value, of spectra as the prior has them."""
    r = response.at(nm)
    return math.sqrt(float(r @ _matern(nm) @ r)) * float(nm[1] - nm[0])


@pytest.mark.parametrize("error", [0.0, 0.02, 0.3])
def test_a_channel_by_itself_is_wieners_one_number(error: float) -> None:
    """w = 1 / (1 + σ²), error σ / √(1 + σ²)."""
    found = combine(RGB[1], [RGB[1]], error)
    assert found.weights == pytest.approx([1 / (1 + error**2)], rel=1e-9)
    assert found.residual == pytest.approx(error / math.sqrt(1 + error**2), abs=1e-7)
    assert found.noise_gain == pytest.approx(1 / (1 + error**2), rel=1e-9)
    assert found.unseen == pytest.approx(0.0, abs=0.04) and MEASURED_ERROR == 0.02


@pytest.mark.parametrize("measured", [RGB, BANDS, _tables(5)])
def test_a_measured_response_is_itself(measured: tuple[Response, ...]) -> None:
    for i, response in enumerate(measured):
        unit = np.eye(len(measured))[i]
        np.testing.assert_allclose(combine(response, measured, 1e-6).weights, unit, atol=1e-6)
        found = combine(response, measured)
        assert found.weights[i] == found.weights.max() > 0.5
        # it may mix others in to lessen noise, and is then better than by itself
        assert found.residual <= MEASURED_ERROR / math.sqrt(1 + MEASURED_ERROR**2) + 1e-9
        require_expressible(found, "here")


def test_a_combination_of_measured_responses_is_found() -> None:
    measured = _tables(5)
    truth = np.array([0.4, 0.0, 0.8, 0.1, 0.3])
    virtual = _table(sum(t * np.array(m.value) for t, m in zip(truth, measured, strict=True)))
    found = combine(virtual, measured)
    fine = np.arange(400.0, 720.1, 1.0)
    each, whole = np.array([_rms(m, fine) for m in measured]), _rms(virtual, fine)
    of_truth = MEASURED_ERROR * float(np.linalg.norm(truth * each)) / whole
    assert 0 < found.residual <= of_truth * 1.001  # least error: no worse than with the true weights
    assert found.residual < MEASURED_ERROR
    require_expressible(found, "here")


def test_without_noise_the_weights_are_those_of_least_squares() -> None:
    measured = _tables(5)
    truth = np.array([0.4, -0.05, 0.8, 0.1, 0.3])
    table = np.stack([m.value for m in measured])
    virtual = _table(np.clip(truth @ table, 0.0, None))
    assert (truth @ table).min() > 0
    expected = np.linalg.lstsq(table.T, np.array(virtual.value), rcond=None)[0]
    np.testing.assert_allclose(expected, truth, atol=1e-10)
    away = [float(np.abs(combine(virtual, measured, e).weights - expected).max()) for e in (1e-2, 1e-3, 1e-4, 1e-5)]
    assert all(b < 0.2 * a for a, b in itertools.pairwise(away)) and away[-1] < 1e-5
    assert combine(virtual, measured, 1e-5).residual < 1e-4


@settings(max_examples=30, deadline=None)
@given(
    centre=st.floats(450.0, 650.0),
    width=st.floats(10.0, 120.0),
    errors=st.lists(st.floats(1e-3, 1.0), min_size=2, max_size=4, unique=True),
)
def test_the_error_grows_with_that_of_what_is_measured(centre: float, width: float, errors: list[float]) -> None:
    virtual = Response(centre_nm=centre, fwhm_nm=width)
    found = [combine(virtual, BANDS, e) for e in sorted(errors)]
    assert all(a.residual <= b.residual + 1e-9 for a, b in itertools.pairwise(found))
    assert all(f.residual <= 1.0 + 1e-9 for f in found)  # no weights at all would be off by 1
    assert all(a.noise_gain >= b.noise_gain - 1e-9 for a, b in itertools.pairwise(found))


@pytest.mark.parametrize(
    "virtual, measured, error",
    [
        (Response(centre_nm=520.0, fwhm_nm=30.0), BANDS, 0.02),
        (Response(centre_nm=620.0, fwhm_nm=11.0), BANDS, 0.1),
        (Response(centre_nm=560.0, fwhm_nm=60.0), RGB, 0.02),
        (Response(centre_nm=760.0, fwhm_nm=60.0), RGB, 0.02),
    ],
)
def test_random_spectra_have_the_error_that_is_stated(virtual: Response, measured: tuple[Response, ...], error: float) -> None:
    found = combine(virtual, measured, error)
    random, count, step = np.random.default_rng(0), 20_000, 1.5
    nm = np.arange(250.0, 900.0, step)  # a grid of its own
    factor = np.linalg.cholesky(_matern(nm) + 1e-9 * np.eye(len(nm)))
    responses = np.stack([r.at(nm) for r in (virtual, *measured)]) * step
    values = (responses @ factor) @ random.normal(size=(len(nm), count))
    true, exact = values[0], values[1:]
    noise = error * np.sqrt((exact**2).mean(1, keepdims=True)) * random.normal(size=exact.shape)
    made = found.weights @ (exact + noise)
    # an rms of n normal numbers is known to 1 / √(2 n); two of them
    tolerance = 4 / math.sqrt(count)
    assert math.sqrt(np.mean((made - true) ** 2) / np.mean(true**2)) == pytest.approx(found.residual, rel=tolerance)
    gain = math.sqrt(np.mean((found.weights @ noise) ** 2) / np.mean(true**2)) / error
    assert gain == pytest.approx(found.noise_gain, rel=tolerance)
    # no other weights do better: the error does not depend on what was measured
    residue = (made - true) / np.sqrt(np.mean((made - true) ** 2))
    for each in exact + noise:
        assert abs(np.mean(residue * each)) < 4 * math.sqrt(np.mean(each**2) / count) + 1e-3 * math.sqrt(np.mean(each**2))


def test_what_lies_beyond_the_measured_range_is_refused_by_its_wavelengths() -> None:
    found = combine(Response(nm=(800.0, 801.0, 899.0, 900.0), value=(0.0, 1.0, 1.0, 0.0)), RGB)
    assert found.unseen == pytest.approx(1.0) and found.residual > RESIDUAL_LIMIT
    ((low, high),) = found.unseen_nm
    assert abs(low - 800) <= 2 and abs(high - 900) <= 2
    with pytest.raises(
        InputError, match=r"my\.toml: channels: x: .*100% of its response lies where .*, (800|801|802)-(898|899|900) nm"
    ) as refused:
        require_expressible(found, "my.toml: channels: x")
    assert "\n" not in str(refused.value) and str(refused.value).count(". ") == 0 and str(refused.value).endswith(".")


def test_a_gap_between_measured_channels_is_named() -> None:
    measured = (Response(centre_nm=450.0, fwhm_nm=20.0), Response(centre_nm=850.0, fwhm_nm=20.0))
    found = combine(Response(nm=(400.0, 900.0), value=(1.0, 1.0)), measured)
    # a Gaussian is above 5 % within √(log 20 / log 16) of its width on either side
    half = 20.0 * math.sqrt(math.log(20) / (4 * math.log(2)))
    assert found.unseen == pytest.approx(1 - 4 * half / 500, abs=6 * 2 / 500)
    edges = np.array(found.unseen_nm)
    expected = [[400, 450 - half], [450 + half, 850 - half], [850 + half, 900]]
    np.testing.assert_allclose(edges, expected, atol=2.1)
    with pytest.raises(InputError, match=" and "):
        require_expressible(found, "here")


def test_broad_channels_cannot_make_a_narrow_one() -> None:
    found = combine(Response(centre_nm=535.0, fwhm_nm=10.0), (Response(nm=(400.0, 1000.0), value=(1.0, 1.0)),))
    assert found.residual > RESIDUAL_LIMIT and found.unseen < 0.01 and found.unseen_nm == ()
    with pytest.raises(InputError, match="too broad or too few") as refused:
        require_expressible(found, "here")
    assert "nm" not in str(refused.value).removeprefix("here") and str(refused.value).endswith(".")


def test_differences_multiply_noise() -> None:
    """A thin slice as the difference of two broad channels: |w| r / r_v each."""
    broad = _table(np.ones(33))
    half = Response(nm=(400.0, 640.0, 641.0, 720.0), value=(1.0, 1.0, 0.0, 0.0))
    slice_ = Response(nm=(640.0, 641.0, 720.0), value=(0.0, 1.0, 1.0))
    found = combine(slice_, (broad, half), 1e-5)
    np.testing.assert_allclose(found.weights, [1.0, -1.0], atol=0.02)
    nm = np.arange(400.0, 720.1, 0.5)
    expected = math.hypot(_rms(broad, nm), _rms(half, nm)) / _rms(slice_, nm)
    assert found.noise_gain == pytest.approx(expected, rel=0.02) and expected > 4
    assert combine(slice_, (broad, half), 0.2).noise_gain < 0.5 * expected  # noisier ones are leant on less


@settings(max_examples=40, deadline=None)
@given(
    factors=st.lists(st.floats(1e-3, 1e3), min_size=8, max_size=8),
    own=st.floats(1e-3, 1e3),
    centre=st.floats(450.0, 650.0),
    width=st.floats(10.0, 100.0),
)
def test_units_do_not_matter(factors: list[float], own: float, centre: float, width: float) -> None:
    virtual = Response(centre_nm=centre, fwhm_nm=width)
    one = combine(virtual, BANDS)
    other = combine(
        virtual.model_copy(update={"peak": own}), [b.model_copy(update={"peak": f}) for b, f in zip(BANDS, factors, strict=True)]
    )
    np.testing.assert_allclose(other.weights, own * one.weights / np.array(factors), atol=1e-9 * own / min(factors), rtol=1e-6)
    assert other.residual == pytest.approx(one.residual, rel=1e-6)
    assert other.noise_gain == pytest.approx(one.noise_gain, rel=1e-6)
    assert other.unseen == pytest.approx(one.unseen, abs=1e-9) and other.unseen_nm == one.unseen_nm


@settings(max_examples=20, deadline=None)
@given(order=st.permutations(range(8)), count=st.integers(1, 7), centre=st.floats(450.0, 650.0))
def test_order_does_not_matter_and_more_channels_do_no_harm(order: list[int], count: int, centre: float) -> None:
    virtual = Response(centre_nm=centre, fwhm_nm=40.0)
    whole, turned = combine(virtual, BANDS), combine(virtual, [BANDS[i] for i in order])
    np.testing.assert_allclose(turned.weights, whole.weights[order], atol=1e-9)
    # on a narrower range of wavelengths the sums are others by what the Gaussians have beyond two widths
    assert whole.residual <= combine(virtual, [BANDS[i] for i in order[:count]]).residual + 1e-4


@pytest.mark.parametrize("width", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("phase", [0.0, 0.5, 1.0])
def test_weights_of_narrow_bands_are_in_proportion_to_their_area(width: float, phase: float) -> None:
    """Against light that is smooth, a line is its area: as much as a broader band of the same area, whose curvature is 1e-3."""
    area = width / 8.0
    line, band = (combine(Response(centre_nm=541.0 + phase, fwhm_nm=w), BANDS) for w in (width, 8.0))
    assert float(line.weights.sum() / band.weights.sum()) == pytest.approx(area, rel=0.01)


def test_nothing_measured_is_refused() -> None:
    with pytest.raises(ValueError, match="no measured responses"):
        combine(RGB[0], [])


def test_a_channel_that_responds_to_nothing_is_refused_or_left_out() -> None:
    """A sentence, not a singular matrix."""
    dead = Response.model_construct(nm=(500.0, 600.0), value=(0.0, 0.0), centre_nm=None, fwhm_nm=None, peak=1.0)
    try:
        found = combine(RGB[1], [RGB[1], dead])
    except ValueError as error:  # numpy's LinAlgError is one, too
        assert not isinstance(error, np.linalg.LinAlgError)
    else:
        assert found.weights[1] == 0.0
