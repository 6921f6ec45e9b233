"""What the operations take, as tuples of tensors and numbers, in one file. The back ends hand them on as they are; numba compiles for their
types.

Symbols: R rays, M measured numbers, L levels of a grid, T rows of its table, F features per level, H units of a hidden layer.
Of what is drawn from: N modalities, F frames, C cameras, T tiles of frames, A analysers; whole numbers are int32 unless said otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor


class GridTable(NamedTuple):
    """A multiresolution hash grid over the cube [-extent, extent]³.

    Attributes:
        table: (T, F), the rows of all levels. resolutions: (L,) int64, cells per axis. offsets: (L + 1,) int64, the rows of each level.
        extent: above 1, space is contracted into the grid (see ``reference.contract``). active: levels in use; others are zero.
    """

    table: Tensor
    resolutions: Tensor
    offsets: Tensor
    extent: float
    active: int


class Cells(NamedTuple):
    """Which cells of a three-state grid over [-extent, extent]³ are looked at, and what the distance at a cell's centre says of it.

    Attributes:
        every, first: of those that are certified every n-th, from one on; all that are not. margin: beyond it no surface is in the cell.
        halves: half cells that are free around it for each unit of distance beyond that.
    """

    extent: float
    every: int
    first: int
    margin: float
    halves: float


class SurfaceNetwork(NamedTuple):
    """One hidden layer above a grid, and the spheres that are the surface at the start.

    Attributes:
        hidden: (H, FIRST_FEATURE_ROW + L F), weights of x, y, z, the bias, then those of the features. output: (H + 1,), bias last.
        inner_radius, outer_radius: of the ball in the middle, of the sphere around everything; in the grid's frame.
    """

    hidden: Tensor
    output: Tensor
    inner_radius: float
    outer_radius: float


class ShaderWeights(NamedTuple):
    """Two hidden layers and the heads of all modalities; weights (out, in), biases (out,)."""

    first: Tensor
    first_bias: Tensor
    second: Tensor
    second_bias: Tensor
    heads: Tensor
    heads_bias: Tensor


class Sampling(NamedTuple):
    """How finely a ray is sampled.

    Attributes:
        sharpness: s of the surface; its soft part is about 3.5 / s thick. step: between samples at the surface, in contracted
            space. active_surface, active_radiance: levels of the grids.
        sphere_step_factor: share of the free distance that a ray goes at once, away from the surface.
        min_slope: a ray that approaches the surface at less than this slope steps as if it had it, see ``march``.
        min_section_weight: sections of a smaller weight are given no appearance of their own.
        max_optical_depth: optical depth at which a ray ends.
    """

    sharpness: float
    step: float
    active_surface: int
    active_radiance: int
    sphere_step_factor: float = 0.7
    min_slope: float = 0.5
    min_section_weight: float = 1e-2
    max_optical_depth: float = 3.0


class Rays(NamedTuple):
    """R rays: origins, directions (R, 3), of unit length; near, far (R,) where they begin and end; jitter (R,) in [0, 1) shifts samples."""

    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor
    jitter: Tensor


class Samples(NamedTuple):
    """N samples, packed ray after ray: t (N,) along the ray, ray (N,) int64, offsets (R + 1,) int64 that delimit the rays."""

    t: Tensor
    ray: Tensor
    offsets: Tensor


class Hits(NamedTuple):
    """What R rays meet: a surface each, and where that covers a pixel in part, at silhouettes and thin parts, what is behind it.

    A row is one surface on one ray: the nearest of each ray, in the order of the rays, and then those behind them, H in all; on a GPU H is
    2 R, and row R + r is of ray r, zeros where nothing is.

    Attributes:
        features: (H, F), the mean over the surface. share: (H,), of the light of its ray. distance: (H,), its mean ray
            distance, 0 = nothing is met; no gradient. behind: (R,) int64, the row of what is
            behind the nearest surface, -1 = nothing; ascending.
        opacity: (R,) in [0, 1], the sum of the shares. depth: (R,), the ray distance at which half of the light is met, NaN = no hit.
        samples: how many were taken, a number.
    """

    features: Tensor
    share: Tensor
    distance: Tensor
    behind: Tensor
    opacity: Tensor
    depth: Tensor
    samples: Tensor


class ShadedRays(NamedTuple):
    """What the shader is given of R rays.

    Attributes:
        features, share, behind: of what they meet, see ``Hits``. directions: (R, 3), unit.
        degrees: (R,) int64, of the harmonics of direction that are seen.
        trains_geometry: (R,) bool; the others pass gradients on to the heads alone, not to features, shares and hidden layers.
    """

    features: Tensor
    share: Tensor
    behind: Tensor
    directions: Tensor
    degrees: Tensor
    trains_geometry: Tensor


class Measured(NamedTuple):
    """M numbers that were measured along rays, radiance before polarization.

    Attributes:
        target: (M,) raw values. ray: (M,) int64, never decreasing within a modality. output: (M,) int64, the shader's output that predicts
            the number, the first of six for a polarization. axes: (P, 3) analyser axes of the last P numbers.
        level, saturation, weight: (M,) the modality's typical value, where it clips, and the share in a mean over modalities.
    """

    target: Tensor
    ray: Tensor
    output: Tensor
    axes: Tensor
    level: Tensor
    saturation: Tensor
    weight: Tensor


class Lamps(NamedTuple):
    """K lamps: position (K, 3), normalised frame; spectrum (K, outputs) of their light in each of the shader's outputs, relative to the
    modality's typical value; of a polarization in the first of six."""

    position: Tensor
    spectrum: Tensor


class Mirrors(NamedTuple):
    """H surfaces that rays meet, see ``Hits``.

    Attributes:
        material: (H, 5 + K) before its functions, see ``mirroring.Material``. normals, points: (H, 3), normalised frame.
        directions: (H, 3) of the rays that meet them, unit. share: (H,).
    """

    material: Tensor
    normals: Tensor
    points: Tensor
    directions: Tensor
    share: Tensor


class LightNetwork(NamedTuple):
    """Lamps, and a hidden layer that tells from features how surfaces mirror them; weights (out, in), biases (out,).

    Attributes:
        second, second_bias: 5 + L outputs: roughness, strength, surroundings, transmitted, polarizing, and the visibility of each of L
            lamps.
        position: (L, 3), normalised frame. log_spectrum: (L, outputs of the shader). used: (K,) int64, ascending: the lamps that there
            are; none: surfaces do not shine, and nothing here is asked.
    """

    first: Tensor
    first_bias: Tensor
    second: Tensor
    second_bias: Tensor
    position: Tensor
    log_spectrum: Tensor
    used: Tensor


class View(NamedTuple):
    """Of R rays: degrees (R,) int64 of the harmonics of direction that are seen; trains_geometry (R,) bool, see ``ShadedRays``."""

    degrees: Tensor
    trains_geometry: Tensor


class Gains(NamedTuple):
    """log_gain (frames,): exposures relative to their mean are exp(log_gain - mean); empty: all are 1. frame: (M,) int64 of each number."""

    log_gain: Tensor
    frame: Tensor


class Opacities(NamedTuple):
    """What is known of the opacity o of R rays, (R,) each, or all empty: Σ weight (o - target)² + linear o + blocked b is part of the loss.

    b = -log(1 - o + left) where o > ``MOSTLY_BLOCKED``, else 0: the optical depth τ, o = 1 - e^-τ,
    of rays along which nothing should be. The
    gradient of o, and of its square, is that of e^-τ: it leaves what has become solid as it is. This one is as strong at every depth; it
    is the emptiness term of the binary cross entropy that NeuS has for masks (Wang et al. 2021, eq. 8).

    Attributes:
        left: share of the light that is left of a ray that was ended.
    """

    target: Tensor
    weight: Tensor
    linear: Tensor
    blocked: Tensor
    left: float


class Eikonal(NamedTuple):
    """Where |∇sdf| = 1 is asked for: at points of all space and, of the surfaces that rays meet, at all if they shine, else at some.

    Attributes:
        points: (P, 3), frame of the grid. noise: (Q, 3): of Q of the R rays, evenly spaced, how far from the surface they meet they ask,
            where it does not shine. weight: of the term, a mean over P + Q, or P + R where surfaces shine. epsilon, mirror_epsilon: of the
            differences, at points and where surfaces shine. shallow: factor, within the unit ball, where the slope is below 1 (not where
            surfaces shine).
    """

    points: Tensor
    noise: Tensor
    weight: float
    epsilon: float
    mirror_epsilon: float
    shallow: float


class Smooth(NamedTuple):
    """Where normals are pulled together: those of some of the surfaces that rays meet, and of places a little beside them, where both are
    outside of the unit ball. Of normals n, n' it is e / (e + c), e = 1 - n·n', c = ``constants.SOFT_EDGE``.

    Attributes:
        aside: (K, 3): of K of the R rays, evenly spaced and one in ``constants.RAYS_OF_PAIR`` at the most, how far beside the surface they
            meet, in distances of it from the centre. weight: of the term, a mean over these rays. epsilon: of the differences.
    """

    aside: Tensor
    weight: float
    epsilon: float


class Step(NamedTuple):
    """What a step of a fit is told, see ``learning.learn``.

    Attributes:
        grid, network, appearance, states, sampling: see ``reference.trace``. far_light: (F,), features of the light that passes
            everything, empty: it is black. rays: their places have no gradient; those from some number on may have no measurements.
        roulette: gradients of tables' rows, and those of the weights behind them, may be estimates that are right in the mean: of rows
            below this share of the root mean square of all of them, some are left out, and others larger (see ``cpu.roulette``). 0: all
            are added, which the definition and a GPU always do.
    """

    grid: GridTable
    network: SurfaceNetwork
    appearance: GridTable
    states: Tensor
    shader: ShaderWeights
    light: LightNetwork
    far_light: Tensor
    rays: Rays
    view: View
    measured: Measured
    gains: Gains
    opacities: Opacities
    eikonal: Eikonal
    smooth: Smooth
    sampling: Sampling
    roulette: float = 0.0


class Arranged(NamedTuple):
    """A step, what is drawn beside it, and what the back end made of both, which holds as long as their tensors do."""

    step: Step
    ahead: tuple[Drawing, ...]
    made: Any = None


class Learned(NamedTuple):
    """Of a step: the loss, a scalar; the sum of all gradients but those of tables, finite if each is; squared (M,), residuals; samples, a
    number; what was drawn beside it."""

    loss: Tensor
    gradients: Tensor
    squared: Tensor
    samples: Tensor
    drawn: tuple[Drawn, ...] = ()


class AdamStep(NamedTuple):
    """What a step of Adam is told beside its tensors.

    Attributes:
        rate, beta1, beta2, epsilon: as Kingma and Ba 2015 name them. number: of the step, 1 at the first.
        sparse: numbers without a gradient keep their value and their moments (``torch.optim.SparseAdam``), as the rows of a table do that
            a step did not meet: otherwise one gradient alone moves them ten times as far as a rate.
    """

    rate: float
    beta1: float
    beta2: float
    epsilon: float
    number: int
    sparse: bool = False


class AdamPart(NamedTuple):
    """What ``reference.adam`` takes of a tensor."""

    parameter: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    step: AdamStep


class Frames(NamedTuple):
    """The F frames of all modalities, those of one together; what they hold, as it was stored.

    Attributes:
        start: (F,) int64, the first value, counted in values of its kind. kind: (F,), 0 = uint8, 1 = uint16, 2 = float32.
        stride: (F,), values of a pixel as stored: those measured, and alpha after them where it is larger by one.
        camera: (F,). first_tile: (F,), ascending.
        rotation: (F, 3, 3), origin: (F, 3), camera to world, normalised frame.
        codes8, codes16, floats: (·,) uint8, uint16, float32: three views of one buffer.
    """

    start: Tensor
    kind: Tensor
    stride: Tensor
    camera: Tensor
    first_tile: Tensor
    rotation: Tensor
    origin: Tensor
    codes8: Tensor
    codes16: Tensor
    floats: Tensor


class Cameras(NamedTuple):
    """C cameras: the directions of their pixels, on nodes.

    Attributes:
        width: (C,) [px]. step: (C,), pixels between nodes; 1: nodes are pixels, else there are four at least along each axis.
        first: (C,) int64, the first node. across, down: (C,), nodes of a row, rows.
        nodes: (·, 3) unit directions in the camera's axes, of pixel (column i step, row j step) at first + j across + i.
    """

    width: Tensor
    step: Tensor
    first: Tensor
    across: Tensor
    down: Tensor
    nodes: Tensor


class Modalities(NamedTuple):
    """N modalities, in the order of batches: polarization last.

    Attributes:
        first_frame, first_tile: (N + 1,). tile_width, tile_height: (N,) [px], powers of two, of 32 pixels at least.
        values: (N,), measured along each ray: one under a mosaic, else a number per channel. output: (N,), of the shader, the first.
        pattern_first: (N,), of its mosaic in ``pattern``, -1 = none. pattern_height, pattern_width: (N,). pattern: (·,), row by row.
        level, saturation: (N,), see ``Measured``. opaque: (N,), alpha where none is stored, NaN = no opacity to match.
        analyser_first: (N,), of its analysers in ``analysers``, -1 = no polarization. analysers: (A, 2), cos and sin of their angles.
    """

    first_frame: Tensor
    first_tile: Tensor
    tile_width: Tensor
    tile_height: Tensor
    values: Tensor
    output: Tensor
    pattern_first: Tensor
    pattern_height: Tensor
    pattern_width: Tensor
    pattern: Tensor
    level: Tensor
    saturation: Tensor
    opaque: Tensor
    analyser_first: Tensor
    analysers: Tensor


class Selection(NamedTuple):
    """Which pixels are drawn, and how often: T tiles, those of a frame together, row by row.

    Attributes:
        ends: (T,) int64, of 2³² random numbers, up to which one draws the tile; of each modality for itself, 2³² its last.
        weight: (T,), of a ray, which makes up for how often its tile is drawn. pixels: (T,), of the tile, how many may be drawn.
        first_word: (N,) int64, of the modality in ``words``, -1 = all pixels may be drawn.
        words: (·,) int32, tile after tile: of each pixel, row by row, a bit, lowest first: whether it may be drawn.
    """

    ends: Tensor
    weight: Tensor
    pixels: Tensor
    first_word: Tensor
    words: Tensor


class Drawn(NamedTuple):
    """R rays and M numbers measured along them, modality after modality; the last P numbers are of polarization.

    Attributes:
        origins, directions: (R, 3), normalised frame. jitter: (R,) in [0, 1). alpha: (R,), opacity, NaN = none to match.
        ray_weight: (R,), of the tile. tile: (R,) int64. frame: (M,) int64, of each number, among all. measured: see ``Measured``.
    """

    origins: Tensor
    directions: Tensor
    jitter: Tensor
    alpha: Tensor
    ray_weight: Tensor
    tile: Tensor
    frame: Tensor
    measured: Measured


class Drawing(NamedTuple):
    """Photosites to draw, see ``drawing.draw``."""

    frames: Frames
    cameras: Cameras
    modalities: Modalities
    selection: Selection
    rays: Sequence[int]
    key: tuple[int, int]
