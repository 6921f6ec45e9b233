"""What the operations take, as tuples of tensors and numbers. The back ends hand them on as they are; numba compiles for their types.

Symbols: R rays, M measured numbers, L levels of a grid, T rows of its table, F features per level, H units of a hidden layer.
"""

from __future__ import annotations

from typing import NamedTuple

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
        min_slope: a ray that approaches the surface at less than this slope steps as if it had it.
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
