"""Light in some channels from light in others: what scenes have in common of spectra.

Everything is said of *reflected* light r: a body's light over what a white board would show there in that channel (its gain and the lamps'
spectrum are then gone), up to one factor for a scene. White is known from a board, from the lamps' stated spectrum, from the lamps that
surfaces mirror, or else taken as grey-world methods do, from the mean colour (``usual``). Whites of scenes whose gains are stated lie near
a line in log space, as those of black bodies do, log w = a + b t + one factor: known channels give t, and t the others.

Of r are kept: second moments over scenes, which give the linear map of least squares (homogeneous: invariant to exposure); and per scene
clusters by chromaticity in all channels, with mean and variance, which say where the linear map errs and how surely. From chromaticities
x of the known channels, e = Σ n_k K(x, x_k) e_k / (Σ n_k K + λ): the residual of clusters, shrunk to the linear map (Nadaraya-Watson with a
prior of λ clusters at 0), and the variance likewise. Two paints of one colour in the known channels are two clusters at one place: their
spread is the deviation.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.prior.samples import SceneSamples, columns_of
from mmsynth.scene.scene import Sensor

_CLUSTERS = 256  # in all
_LEAST_PIXELS = 5  # of a cluster
_DARK = 0.03  # of the scene's mean, below which light has no colour
_BRIGHT = 4.0  # chromaticity, above which a channel is as good as alone
_RIDGE = 1e-4  # of the mean square of a known channel
_WIDTH = 0.05  # of the kernel, in chromaticity over the mean channel
_SHRINK = 0.08  # clusters' worth of "as the linear map has it", for each scene
_FAR = 3.0  # kernel widths from the nearest cluster, at which the deviation has grown by sqrt(2)
_COLOUR_ERROR = 0.3  # of the log of the mean colour, where too few scenes tell
_LAMP_ERROR = 0.03  # of the log of a lamp's spectrum, at the least
_STEADY = 1e-3  # mean square of whites off their mean, below which there is no line
_UNKNOWN_GAIN = 0.5  # deviation of the log


@dataclass(frozen=True)
class Spectra:
    """Statistics of C channels, the columns of ``columns_of`` the prior's sensors. NaN: no scene has both, or a cluster's scene has not.

    Attributes:
        moments: (C, C), mean over scenes of r rᵀ, scenes scaled to mean 1. usual: (2, C) log of the mean r, and its deviation between
            scenes.
        mean, spread: (K, C) of r over its mean channel, of clusters; spread is a variance. share: (K,) of their scene's pixels.
        scenes: how many were learned from.
        line: (3, C), a, b and the deviation from the line of log white over gain. raw: (2, C), mean and deviation of log white where
            gains are not looked at.
    """

    moments: np.ndarray
    usual: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    share: np.ndarray
    scenes: int
    line: np.ndarray
    raw: np.ndarray


@dataclass(frozen=True)
class White:
    """What a white board shows in each of C channels of a scene, 1.0 = full scale, up to the scene's one factor.

    Attributes:
        log: (C,). deviation: (C,) of it. free: (C,) bool, where no gain was stated: the level is what is usual.
        how: where the known channels' is from, in words.
    """

    log: np.ndarray
    deviation: np.ndarray
    free: np.ndarray
    how: str


def learn_spectra(sensors: Mapping[str, Sensor], scenes: Sequence[SceneSamples], seed: int = 0) -> Spectra:
    """Learn from samples of one or more scenes; ``sensors``: of all of them."""
    columns = columns_of(sensors)
    count = max((c.stop for c in columns.values()), default=0)
    body = [_joined(columns, scene.body, count) for scene in scenes]
    log_mean = np.stack([_log_mean(values) for values in body])
    lamps = [_lamp_of(columns, scene, count) for scene in scenes]
    known = [i for i, lamp in enumerate(lamps) if lamp is not None]
    # the colour of a mean surface, from scenes whose lamps are known
    colour = _centred(np.stack([log_mean[i] - lamps[i] for i in known])) if known else np.zeros((1, count))
    usual = np.stack([np.nanmean(colour, 0), np.nanstd(colour, 0) if len(colour) > 2 else np.full(count, _COLOUR_ERROR)])
    whites = _centred(np.stack([lamp if lamp is not None else mean - usual[0] for lamp, mean in zip(lamps, log_mean, strict=True)]))
    moments, pairs = np.zeros((count, count)), np.zeros((count, count))
    means, spreads, shares = [], [], []
    per_scene = max(4, _CLUSTERS // len(scenes))
    for i, values in enumerate(body):
        reflected = values / np.exp(whites[i])
        reflected /= np.nanmean(reflected)
        has = np.isfinite(whites[i])
        known_part = np.where(has, reflected, 0.0)
        moments += known_part.T @ known_part / len(reflected)
        pairs += np.outer(has, has)
        mean, spread, share = _clusters(reflected, has, per_scene, np.random.default_rng((seed, i)))
        means.append(mean)
        spreads.append(spread)
        shares.append(share)
    gains = np.stack([_log_gains(columns, scene, count) for scene in scenes])
    with np.errstate(invalid="ignore", divide="ignore"):
        moments = np.where(pairs > 0, moments / pairs, np.nan)
    return Spectra(
        moments=moments,
        usual=usual,
        mean=np.concatenate(means),
        spread=np.concatenate(spreads),
        share=np.concatenate(shares),
        scenes=len(scenes),
        line=_line(whites - gains),
        raw=_mean_and_deviation(whites),
    )


def white_of(
    spectra: Spectra, columns: Mapping[str, slice], known: Sequence[str], scene: SceneSamples, lit: np.ndarray | None = None
) -> White:
    """White of a scene in all channels, from what is stated, from its lamps, or from its mean colour in the ``known`` modalities.

    Args:
        lit: (C,) log of what a white board shows under the stated lamp at a gain of 1, up to one number; NaN where that is not known.
    """
    count = spectra.usual.shape[1]
    given = np.concatenate([np.arange(count)[columns[name]] for name in known])
    boards = _joined_logs(columns, scene.exposure.white, count)
    noise = np.maximum(spectra.line[2], _LAMP_ERROR)
    lit = np.full(count, np.nan) if lit is None else lit
    if np.isfinite(boards[given]).all():
        log, how = boards, "a white board"
    elif np.isfinite(lit[given]).all():
        log, how = _log_mean(_joined(columns, scene.body, count)), "the stated lamp"
        for name in known:  # of the mean only the level, which the gain may not say
            of = np.arange(count)[columns[name]]
            log[of] = lit[of] + (log - lit)[of].mean()
    elif scene.lamp is not None:
        log, how = _joined_logs(columns, scene.lamp, count), "the lamps that surfaces mirror"
    else:
        log, how = _log_mean(_joined(columns, scene.body, count)) - spectra.usual[0], "the mean colour"
        noise = np.hypot(noise, spectra.usual[1])
    log = log - log[given].mean()
    lamp, of_lamp = _on_line(spectra, columns, known, log, noise)
    if np.isfinite(lit).any():  # said, and not only what lamps are like
        both = np.isfinite(lit + lamp)
        lamp = np.where(np.isfinite(lit), lit + float((lamp - lit)[both].mean() if both.any() else 0.0), lamp)
        of_lamp = np.where(np.isfinite(lit), _LAMP_ERROR, of_lamp)
    line = lamp + _log_gains(columns, scene, count)
    anchors = given[np.isfinite(line[given])]
    level = float((log - line)[anchors].mean()) if len(anchors) else np.nan
    if how == "the mean colour":  # of a few things it says less than what lamps are like
        for name in known:
            of = np.arange(count)[columns[name]]
            if np.isfinite(lamp[of]).all():
                log[of] = lamp[of] - lamp[of].mean() + log[of].mean()
    free = ~np.isfinite(line + level)
    expected = np.where(free, spectra.raw[0] + float((log - spectra.raw[0])[given].mean()), line + level)
    deviation = np.where(free, spectra.raw[1], of_lamp)
    measured = np.isin(np.arange(count), given) | (np.isfinite(boards) & (how == "a white board"))
    return White(np.where(measured, log, expected), np.where(measured, 0.0, deviation), free & ~measured, how)


def _on_line(
    spectra: Spectra, columns: Mapping[str, slice], known: Sequence[str], log: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log white over gain (C,), NaN where the line is not known, and its deviation: where on the line the colours within the ``known``
    modalities lie, whatever their gains."""
    a, b, off = spectra.line
    square = product = 0.0
    for name in known:
        of = np.arange(len(a))[columns[name]]
        if np.isfinite(a[of]).all():
            slope, rest = b[of] - b[of].mean(), (log - a)[of] - (log - a)[of].mean()
            square += float((slope**2 / noise[of] ** 2).sum())
            product += float((slope * rest / noise[of] ** 2).sum())
    return a + b * product / (square + 1.0), np.sqrt(off**2 + b**2 / (square + 1.0))


@dataclass(frozen=True)
class SpectralMap:
    """From known channels (A) to wanted ones (B) of one scene, on tensors.

    Attributes:
        known, wanted: (A,), (B,) what a white board shows there, 1.0 = full scale. linear: (A, B), of reflected light.
        chroma: (K, A) of clusters. residual, variance: (K, B) of what the linear map misses there, over the mean known channel, and
            ``has``: (K, B), 1 where the cluster says something, times its share. base: (B,) variance over all clusters. shrink:
            clusters' worth.
    """

    known: Tensor
    wanted: Tensor
    linear: Tensor
    chroma: Tensor
    residual: Tensor
    variance: Tensor
    has: Tensor
    base: Tensor
    shrink: float

    def __call__(self, light: Tensor) -> tuple[Tensor, Tensor]:
        """Light (R, A) ≥ 0, 1.0 = full scale → light (R, B) and its standard deviation as far as spectra differ, (R, B)."""
        reflected = light / self.known
        mean = reflected.mean(1, keepdim=True)
        lit = mean > 0
        chroma = reflected / torch.where(lit, mean, torch.ones_like(mean))
        distance = (
            chroma.square().mean(1, keepdim=True) + self.chroma.square().mean(1) - 2.0 * chroma @ self.chroma.T / light.shape[1]
        ).clamp(min=0.0)
        kernel = torch.exp(-0.5 * distance / _WIDTH**2)
        total = kernel @ self.has + self.shrink
        residual = kernel @ (self.has * self.residual) / total
        # far from all that was seen anything may be
        grown = 1.0 + distance.min(1, keepdim=True).values / (_FAR * _WIDTH) ** 2
        square = (kernel @ (self.has * (self.residual.square() + self.variance)) + self.shrink * self.base * grown) / total
        variance = (square - residual.square()).clamp(min=0.0)
        value = (reflected @ self.linear + residual * mean).clamp(min=0.0) * self.wanted
        return value, torch.sqrt(variance) * mean * self.wanted


def spectral_map(spectra: Spectra, white: White, given: np.ndarray, wanted: np.ndarray) -> SpectralMap:
    """The map from the columns ``given`` to the columns ``wanted`` (indices)."""
    gram = spectra.moments[np.ix_(given, given)]
    cross = spectra.moments[np.ix_(given, wanted)]
    ridge = _RIDGE * np.trace(gram) / len(given)
    linear = np.linalg.solve(gram + ridge * np.eye(len(given)), cross)
    usable = np.isfinite(spectra.mean[:, given]).all(1)
    of_known = spectra.mean[np.ix_(usable, given)]
    level = of_known.mean(1, keepdims=True)
    means, spreads = spectra.mean[np.ix_(usable, wanted)] / level, spectra.spread[np.ix_(usable, wanted)] / level**2
    chroma = of_known / level
    says = np.isfinite(means)
    residual = np.where(says, means - chroma @ linear, 0.0)
    variance = np.where(says, spreads, 0.0)
    weight = says * spectra.share[usable][:, None]
    base = (weight * (residual**2 + variance)).sum(0) / np.maximum(weight.sum(0), 1e-12)
    if not usable.any():  # no pixel of any scene was bright enough to have a colour: all that is known is what the linear map misses
        nothing = np.zeros((1, len(wanted)))
        chroma, residual, variance, weight = np.ones((1, len(given))), nothing, nothing, nothing
        base = np.maximum(np.diag(spectra.moments)[wanted] - (linear * cross).sum(0), 0.0) * len(given) / np.trace(gram)
    tensor = lambda a: torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32))
    return SpectralMap(
        known=tensor(np.exp(white.log[given])),
        wanted=tensor(np.exp(white.log[wanted])),
        linear=tensor(linear),
        chroma=tensor(chroma),
        residual=tensor(residual),
        variance=tensor(variance),
        has=tensor(weight),
        base=tensor(base),
        shrink=_SHRINK * spectra.scenes,
    )


def _joined(columns: Mapping[str, slice], values: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    """(N, C), NaN where a modality is missing."""
    rows = len(next(iter(values.values())))
    out = np.full((rows, count), np.nan)
    for name, value in values.items():
        out[:, columns[name]] = np.maximum(value, 0.0)
    return out


def _joined_logs(columns: Mapping[str, slice], values: Mapping[str, Sequence[float] | np.ndarray], count: int) -> np.ndarray:
    """(C,), NaN where nothing is said."""
    out = np.full(count, np.nan)
    for name in values.keys() & columns.keys():
        value = values[name]
        out[columns[name]] = np.log(np.maximum(np.asarray(value, dtype=np.float64), 1e-12))
    return out


def _lamp_of(columns: Mapping[str, slice], scene: SceneSamples, count: int) -> np.ndarray | None:
    """Log white (C,) of a scene that is learned from: of boards where all are stated, else of its lamps, else unknown."""
    if all(name in scene.exposure.white for name in scene.body):
        return _joined_logs(columns, {name: scene.exposure.white[name] for name in scene.body}, count)
    return None if scene.lamp is None else _joined_logs(columns, scene.lamp, count)


def _log_gains(columns: Mapping[str, slice], scene: SceneSamples, count: int) -> np.ndarray:
    stated = {name: [gain] * (columns[name].stop - columns[name].start) for name, gain in scene.exposure.gain.items() if name in columns}
    return _joined_logs(columns, stated, count)


def _log_mean(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.log(np.maximum(values.mean(0), 1e-12)))


def _centred(log: np.ndarray) -> np.ndarray:
    """Logs (scenes, C) without the one factor of each scene: of the channels that all scenes have, where there are any."""
    shared = np.isfinite(log).all(0)
    if not shared.any():
        return log - np.nanmean(log, axis=1, keepdims=True)
    return log - log[:, shared].mean(1, keepdims=True)


def _mean_and_deviation(log: np.ndarray) -> np.ndarray:
    """(2, C) over scenes (scenes, C); of one scene the deviation is that of not knowing."""
    enough = np.isfinite(log).sum(0) > 1
    return np.stack([np.nanmean(log, 0), np.where(enough, np.nanstd(log, 0), _UNKNOWN_GAIN)])


def _line(log: np.ndarray) -> np.ndarray:
    """(3, C): a, b and the deviation of log whites (scenes, C) from the line a + b t, t of variance 1; a is NaN where no gain was
    stated."""
    log = log[np.isfinite(log).any(1)]
    count = log.shape[1]
    if not len(log):
        return np.stack([np.full(count, np.nan), np.zeros(count), np.full(count, _UNKNOWN_GAIN)])
    log = _centred(log)
    has = np.isfinite(log)
    shared, counted = has.all(0), has.sum(0)
    a = np.where(counted > 0, np.where(has, log, 0.0).sum(0) / np.maximum(counted, 1), np.nan)
    off = np.where(has, log - a, 0.0)
    b = np.zeros(count)
    if float((off[:, shared] ** 2).mean() if shared.any() else 0.0) > _STEADY:
        left, scale, _ = np.linalg.svd(off[:, shared], full_matrices=False)
        t = left[:, 0] * scale[0]
        t = t / t.std()
        b = (t[:, None] * off).sum(0) / np.maximum((has * t[:, None] ** 2).sum(0), 1e-12)
        off = np.where(has, off - b * t[:, None], 0.0)
    deviation = np.where(counted > 1, np.sqrt((off**2).sum(0) / np.maximum(counted - 1, 1)), _UNKNOWN_GAIN)
    return np.stack([a, b, deviation])


def _clusters(reflected: np.ndarray, has: np.ndarray, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, variances (K, C) and shares (K,) of clusters by chromaticity of (N, C); bright pixels weigh more, as their noise is less."""
    from scipy.cluster.vq import kmeans2  # a quarter of a second to import

    level = np.nanmean(reflected, 1)
    chosen = level > _DARK
    chroma, weight = reflected[chosen] / level[chosen, None], level[chosen] ** 2
    place = np.sqrt(np.minimum(chroma[:, has], _BRIGHT))  # of equal noise at any brightness, about
    means, spreads, shares = [], [], []
    if len(chroma) >= _LEAST_PIXELS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # fewer colours than clusters: some are empty
            _, label = kmeans2(place, min(count, len(chroma) // _LEAST_PIXELS), minit="++", rng=random)
        for k in np.unique(label):
            of = label == k
            if of.sum() < _LEAST_PIXELS:
                continue
            mean = (weight[of, None] * chroma[of]).sum(0) / weight[of].sum()
            means.append(mean)
            spreads.append((weight[of, None] * (chroma[of] - mean) ** 2).sum(0) / weight[of].sum())
            shares.append(of.mean())
    width = reflected.shape[1]
    return np.reshape(means, (-1, width)), np.reshape(spreads, (-1, width)), np.array(shares, dtype=np.float64)
