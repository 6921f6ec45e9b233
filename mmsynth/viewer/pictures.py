"""What one browser sees: pictures that get finer while its camera rests."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mmsynth.field.field import Field
from mmsynth.operations.views.coverage import TrainingRays, coverage
from mmsynth.operations.views.displays import Display, Seen, look, picture
from mmsynth.scene.preview_colours import PreviewColours
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import resized

_FIRST_SECONDS = 0.08  # that the first, coarse picture may take
_AT_ONCE = 2.3  # times that is little enough for the full picture to be the first
_STEP = 2  # finer, from one picture to the next
_LEAST = 24  # pixels in a row
_QUICK = 0.7  # of a measured speed, how much is new


@dataclass(frozen=True)
class Wanted:
    """What a browser wants to see.

    Attributes:
        left, right: displays on both sides of the wipe. wipe: share of the width that is the left one's. stops: exposure, in powers of two.
        tone: see ``picture``. most: pixels of the longer side.
    """

    left: Display
    right: Display
    wipe: float = 1.0
    stops: float = 0.0
    tone: float = 1.0
    most: int = 1920

    @property
    def displays(self) -> tuple[Display, ...]:
        return (*([self.left] if self.wipe > 0.0 else []), *([self.right] if self.wipe < 1.0 else []))


class Looking:
    """One browser's picture, as far as it is. All but ``finer`` may be called from any thread.

    Attributes:
        view: from where, on as many pixels as the browser has; None: not known yet. wanted: what. seen: what was rendered last.
    """

    def __init__(self, wanted: Wanted) -> None:
        self.wanted = wanted
        self.view: PosedCamera | None = None
        self.seen: Seen | None = None
        self._seen_of: tuple[Display, ...] = ()
        self._generation = 0
        self._sizes: list[int] | None = []  # None: to be planned
        self.rays_per_second = 100_000.0

    def move(self, view: PosedCamera) -> None:
        """Look from elsewhere."""
        self.view = view
        self.again()

    def again(self) -> None:
        """Start over, coarsely: something is not as it was."""
        self._generation += 1
        self._sizes = None

    def wish(self, wanted: Wanted) -> bool:
        """Look at something else; whether what was rendered last is enough for it, and only has to be shown."""
        enough = self.seen is not None and set(wanted.displays) <= set(self._seen_of) and wanted.most == self.wanted.most
        self.wanted = wanted
        if not enough:
            self.again()
        return enough

    @property
    def finished(self) -> bool:
        """Whether nothing is left to be rendered."""
        return self.view is None or self._sizes == []

    @property
    def coarse(self) -> bool:
        """Whether not even the first picture is there."""
        return self._sizes is None

    def finer(self, field: Field, training: Callable[[], TrainingRays | None], go_on: Callable[[], bool] = lambda: True) -> bool:
        """Render the next picture: whether there is one, and it is not stale.

        Args:
            training: gives the training frames' depth maps, for coverage. go_on: asked now and then; False: there is something more urgent
                than a finer picture.
        """
        view, wanted, generation = self.view, self.wanted, self._generation
        if view is None:
            return False
        sizes = self._sizes
        first = sizes is None
        if sizes is None:
            sizes = sizes_of(view.camera.width, view.camera.height, wanted.most, _FIRST_SECONDS * self.rays_per_second)
            self._sizes = sizes
        if not sizes:
            return False
        small = PosedCamera(resized(view.camera, sizes[0]), view.camera_to_world)
        began = time.perf_counter()
        # a first picture is soon there, and a camera that moves all the time must see some
        seen = look(field, small, wanted.displays, lambda: first or (generation == self._generation and go_on()))
        if seen is None or (generation != self._generation and not first):
            return False
        if any(display.kind == "coverage" for display in wanted.displays):
            seen = {**seen, "coverage": coverage_of(small, seen, field, training())}
        speed = small.camera.width * small.camera.height / max(time.perf_counter() - began, 1e-3)
        self.rays_per_second += _QUICK * (speed - self.rays_per_second)
        self.seen, self._seen_of = seen, wanted.displays
        if generation == self._generation:
            self._sizes = sizes[1:]
        return True

    def picture(
        self, field: Field, exposures: Callable[[Display], float], colours: dict[str, PreviewColours], depth: tuple[float, float] | None
    ) -> np.ndarray | None:
        """(H, W, 3) uint8 of what was rendered last, both sides of the wipe; None where that is of something else."""
        wanted, seen = self.wanted, self.seen
        if seen is None or not set(wanted.displays) <= set(self._seen_of):
            return None
        shown = [
            picture(field, display, seen, exposures(display) * 2.0**wanted.stops, wanted.tone, colours, depth)
            for display in wanted.displays
        ]
        if len(shown) == 1:
            return shown[0]
        width = shown[0].shape[1]
        edge = min(width - 1, max(1, round(wanted.wipe * width)))
        out = shown[1].copy()
        out[:, :edge] = shown[0][:, :edge]
        out[:, edge - (width > 400) : edge + 1] = 255
        return out


def sizes_of(width: int, height: int, most: int, rays: float) -> list[int]:
    """Widths of the pictures of a view, from one of about so many rays to the full one."""
    final = max(1, round(width * min(1.0, most / max(width, height))))
    aspect = height / width
    first = int((rays / aspect) ** 0.5)
    if final**2 * aspect <= _AT_ONCE * rays:
        return [final]
    out = [final]
    while out[0] > first and out[0] > _LEAST:
        out.insert(0, max(_LEAST, first, out[0] // _STEP))
    return out


def coverage_of(view: PosedCamera, seen: Seen, field: Field, training: TrainingRays | None) -> np.ndarray:
    """(H, W), see ``coverage``; NaN everywhere where there are no training frames."""
    if training is None:
        return np.full(seen["depth"].shape, np.nan, np.float32)
    return coverage(training, view, seen["depth"] * np.float32(field.region.radius), seen["normal"])
