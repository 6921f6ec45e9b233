"""Which method to believe, for a pair of modalities: what the scene's own training frames say.

At training views that have frames of both modalities, the source's frame is converted, as the target's sensor, and compared with the
target's raw frame, photosite by photosite (``nearest`` does without the target's frame of that view). The result is not one method but
how much of each: the weights w ≥ 0, Σ w ≤ 1 that make

    field + Σ_k w_k (method_k - field)

nearest to the frames (least squares; stacking: Wolpert 1992, with the bounds of Breiman 1996). So a correction that carries over by half
is taken by half, and one that does not is left.

The field has learned from these very frames. At views that it has not seen it is worse, and all else is better in comparison, than the
frames say. How much worse shows in the frame that is converted: where its own residual, of relative variance τ² (``guidance``), exceeds
what the training frames of the source show, τ₀² in the mean, the field's squared error in the target, E, is taken to be larger by the
same factor,

    e² = E (τ² / τ₀² - 1)

This error is one that ``linear`` and ``nearest`` do not have, and of which corrections mend a share. The normal equations follow: G and h
gain e² where both of two methods mend it, and the share where one is a correction.

On the source's own pixels nothing is blurred on its way through the surface: there h of a correction is larger by as much as that costs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mmsynth.operations.conversion.moving_light import MovingLight, moving_light
from mmsynth.operations.conversion.predictions import (
    WARPED_SHARE,
    Prediction,
    Training,
    compare,
    in_one_place,
    learn_training,
    predict,
)
from mmsynth.operations.conversion.windows import WINDOW, opened
from mmsynth.scene.scene import Scene, Sensor
from mmsynth.sensors.metrics import psnr_from_mse
from mmsynth.sensors.mosaic import photosites_of
from mmsynth.sensors.polarization import stokes_to_intensities

if TYPE_CHECKING:
    from mmsynth.field.field import Field

_VIEWS = 4  # six or three choose as well, two lose up to 0.14 dB
_SEEN_BY_CORRECTIONS = 0.5  # share of an error at unseen views that the source has, too: squared correlation of residuals there
_LEAST = 0.03  # a weight below that is none


@dataclass(frozen=True)
class Evidence:
    """What the training frames say of a pair.

    Attributes:
        training: what ``linear`` and ``nearest`` need. views: the training views that were looked at. psnr: of each method there [dB].
        methods: the K that may take part. gram, product: (K, K) and (K,), means over photosites of (method - field) times itself, and
            times (frame - field). error: mean (frame - field)². variance: τ₀². together: whether both sensors look from one place
            through one lens, so that nothing is carried through the surface. lights: of both modalities, whether they move with the camera.
    """

    source: str
    target: str
    training: Training
    views: tuple[int, ...]
    psnr: dict[str, float]
    methods: tuple[Prediction, ...]
    gram: np.ndarray
    product: np.ndarray
    error: float
    variance: float
    together: bool
    lights: dict[str, MovingLight]

    def weights(self, prior_sd: float, carried: bool) -> dict[Prediction, float]:
        """How much of each method, 1 in all.

        Args:
            prior_sd: τ of the frame (``Guide``), within the window around the region. carried: whether the target looks from its own place.
        """
        corrections = np.array([name in ("ratio", "guided") for name in self.methods])
        unseen = self.error * max(prior_sd**2 / self.variance - 1.0, 0.0)
        mended = np.where(corrections, _SEEN_BY_CORRECTIONS, 1.0)
        gram = self.gram + unseen * np.minimum(mended[:, None], mended[None, :])
        product = self.product + unseen * mended
        if not carried and not self.together:
            product = np.where(corrections, product / WARPED_SHARE, product)
        found = zip(self.methods, _bounded(gram, product), strict=True)
        chosen: dict[Prediction, float] = {name: float(weight) for name, weight in found if weight >= _LEAST}
        return {"field": max(1.0 - sum(chosen.values()), 0.0), **chosen}

    def facts(self) -> dict[str, Any]:
        """For JSON."""
        moving = [name for name, light in self.lights.items() if light.moves]
        lights = {name: {"share": light.share, "sd": light.sd} for name, light in self.lights.items() if np.isfinite(light.sd)}
        return {"views": list(self.views), "psnr": self.psnr, "light_moves": moving, "light_of_the_camera": lights}


def gather(field: Field, scene: Scene, source: str, target: str, lights: dict[str, MovingLight] | None = None) -> Evidence | None:
    """Look at a few training views; None where none has frames of both, or the two are one modality.

    Args:
        lights: those of this scene that are known already; others are added.
    Raises:
        InputError: no training frames of one of the two.
    """
    sensor = field.sensors[target]
    theirs = {frame.view: frame for frame in scene.frames_of(target, scene.split.train)}
    frames = [frame for frame in scene.frames_of(source, scene.split.train) if frame.view in theirs]
    if source == target or not frames:
        return None
    lights = {} if lights is None else lights
    for name in {source, target} - lights.keys():
        lights[name] = moving_light(field, scene, name)
    training = learn_training(field, scene, source, target)
    frames = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, _VIEWS).round().astype(int))]
    names: tuple[Prediction, ...] = ("ratio", "guided", "linear", "nearest")
    grams, products, errors, variances, together = [], [], [], [], True
    for frame in frames:
        raw, view = opened(field, frame, WINDOW)
        real, seen_by = opened(field, theirs[frame.view], WINDOW)
        together &= in_one_place(view, seen_by)
        compared = compare(field, raw, view, source, target)
        said = predict(
            field, compared, source, target, names, training=training, seen_by=seen_by, left_out=frame.view, to_weigh=True, of_region=True
        )
        used = np.broadcast_to(said.there.valid.reshape(said.there.valid.shape + (1,) * (real.ndim - 2)), real.shape)
        used = used & (real < sensor.saturation)
        photosites = {name: _photosites(light.astype(np.float64), sensor)[used] for name, light in said.light.items()}
        left = real[used] - photosites["field"]
        apart = np.stack([photosites[name] - photosites["field"] for name in names])
        grams.append(apart @ apart.T / max(len(left), 1))
        products.append(apart @ left / max(len(left), 1))
        errors.append(float(np.mean(left**2)) if len(left) else 0.0)
        variances.append(compared.guidance.prior_sd**2)
    gram, product, error = np.mean(grams, 0), np.mean(products, 0), float(np.mean(errors))
    mean_square = np.maximum(error - 2.0 * product + np.diag(gram), 1e-12)
    psnr: dict[str, float] = {"field": psnr_from_mse(max(error, 1e-12))}
    psnr |= {name: psnr_from_mse(float(value)) for name, value in zip(names, mean_square, strict=True)}
    # of the two corrections, the one that explains more
    explained = np.maximum(product[:2], 0.0) ** 2 / np.maximum(np.diag(gram)[:2], 1e-12)
    keep = [int(explained[1] > explained[0]), 2, 3]
    return Evidence(
        source=source,
        target=target,
        training=training,
        views=tuple(frame.view for frame in frames),
        psnr=psnr,
        methods=tuple(names[i] for i in keep),
        gram=gram[np.ix_(keep, keep)],
        product=product[keep],
        error=error,
        variance=max(float(np.mean(variances)), 1e-9),
        together=together,
        lights={name: lights[name] for name in (source, target)},
    )


def _photosites(light: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Light → what the sensor's photosites measure of it, shaped as its raw frames."""
    channels = light
    if sensor.is_polarization:
        channels = stokes_to_intensities(torch.from_numpy(light), sensor.polarizer_angles_deg or ()).numpy()
    channels = np.maximum(channels, 0.0)
    return channels if sensor.mosaic is None else photosites_of(channels, sensor.mosaic)


def _bounded(gram: np.ndarray, product: np.ndarray) -> np.ndarray:
    """(K,) w ≥ 0 with Σ w ≤ 1 that minimise wᵀ G w - 2 hᵀ w."""
    from scipy.optimize import nnls  # half a second to import

    count = len(product)
    root = np.linalg.cholesky(gram + (1e-6 * np.trace(gram) / count + 1e-15) * np.eye(count))
    goal = np.linalg.solve(root, product)
    found = nnls(root.T, goal)[0]
    if found.sum() > 1.0:  # then the bound holds with equality: one more equation, of great weight
        weight = 1e4 * np.sqrt(np.trace(gram) + 1e-15)
        found = nnls(np.vstack([root.T, np.full(count, weight)]), np.append(goal, weight))[0]
    return np.asarray(found)
