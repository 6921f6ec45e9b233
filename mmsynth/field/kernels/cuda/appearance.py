"""What surfaces look like, in Triton: features where sections cross them, their mean over each surface of a ray, and its gradients.

One ray per lane, along its list of sections (see ``sections``).
"""

from __future__ import annotations

from mmsynth.field.kernels.cuda.encoding import encode, scatter, slope, to_frame, unit_cube
from mmsynth.field.kernels.cuda.shared import COLUMNS, MAX_SAMPLES, back_to_world, contracted, jit, position, tl


@jit
def look_kernel(  # type: ignore[no-untyped-def]
    origins, directions, sections, section_k, section_count, second, shown, table, resolutions, offsets, out, scale, rays, width, active,
    CONTRACTED: tl.constexpr, FEATURES: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Features (2 rays, width) of surfaces; a program does ``COLUMNS`` of them."""
    ray = tl.program_id(0) * LANES + tl.arange(0, LANES)
    live = ray < rays
    first = tl.program_id(1) * (COLUMNS // FEATURES)
    column = first * FEATURES + tl.arange(0, COLUMNS)
    count = tl.load(section_count + ray, mask=live, other=0)
    begins = tl.load(second + ray, mask=live, other=0)
    ox, oy, oz = position(origins, ray, live)
    dx, dy, dz = position(directions, ray, live)
    front = tl.zeros([LANES, COLUMNS], tl.float32)
    rear = tl.zeros([LANES, COLUMNS], tl.float32)
    for j in range(0, tl.max(count, 0)):
        there = j < count
        at = sections + j * rays + ray
        t = tl.load(at, mask=there, other=0.0)
        w = tl.load(at + rays * MAX_SAMPLES, mask=there, other=0.0)
        is_rear = tl.load(section_k + j * rays + ray, mask=there, other=0) >= begins
        x, y, z, _ = contracted(ox + dx * t, oy + dy * t, oz + dz * t, CONTRACTED)
        ux, uy, uz = unit_cube(x, y, z, scale)
        e = w[:, None] * encode(ux, uy, uz, there, table, resolutions, offsets, first, active, FEATURES)
        front += tl.where(is_rear[:, None], 0.0, e)
        rear += tl.where(is_rear[:, None], e, 0.0)
    here = live[:, None] & (column < width)[None, :]
    at = out + ray.to(tl.int64)[:, None] * width + column[None, :]
    tl.store(at, front / tl.load(shown + ray, mask=live, other=1.0)[:, None], mask=here)
    rest = rays.to(tl.int64) * width
    tl.store(at + rest, rear / tl.load(shown + rays + ray, mask=live, other=1.0)[:, None], mask=here)


@jit
def look_backward_kernel(  # type: ignore[no-untyped-def]
    origins, directions, sections, section_k, section_count, second, shown, features, g_features, table, resolutions, offsets,
    table_out, weights_out, places_out, scale, rays, width, active,
    CONTRACTED: tl.constexpr, FEATURES: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Gradients of features: to the table; weights_out (MAX_SAMPLES, rays): to the weights of sections that matter; places_out
    (3, MAX_SAMPLES, rays), or None: to where they cross the surface, in the frame of the rays."""
    ray = tl.program_id(0) * LANES + tl.arange(0, LANES)
    live = ray < rays
    plane = rays * MAX_SAMPLES
    count = tl.load(section_count + ray, mask=live, other=0)
    begins = tl.load(second + ray, mask=live, other=0)
    ox, oy, oz = position(origins, ray, live)
    dx, dy, dz = position(directions, ray, live)
    for j in range(0, tl.max(count, 0)):
        there = j < count
        at = j * rays + ray
        t = tl.load(sections + at, mask=there, other=0.0)
        w = tl.load(sections + plane + at, mask=there, other=0.0)
        row = tl.where(tl.load(section_k + at, mask=there, other=0) >= begins, rays + ray, ray)
        divided = 1.0 / tl.load(shown + row, mask=there, other=1.0)
        px, py, pz = ox + dx * t, oy + dy * t, oz + dz * t
        x, y, z, _ = contracted(px, py, pz, CONTRACTED)
        ux, uy, uz = unit_cube(x, y, z, scale)
        to_weight = tl.zeros([LANES], tl.float32)
        gx = tl.zeros([LANES], tl.float32)
        gy = tl.zeros([LANES], tl.float32)
        gz = tl.zeros([LANES], tl.float32)
        for first in range(0, active, COLUMNS // FEATURES):
            column = first * FEATURES + tl.arange(0, COLUMNS)
            here = there[:, None] & (column < active * FEATURES)[None, :]
            of_row = row.to(tl.int64)[:, None] * width + column[None, :]
            g = tl.load(g_features + of_row, mask=here, other=0.0)
            mean = tl.load(features + of_row, mask=here, other=0.0)
            e = encode(ux, uy, uz, there, table, resolutions, offsets, first, active, FEATURES)
            to_weight += tl.sum(g * (e - mean), 1)
            g = g * (w * divided)[:, None]
            if table_out is not None:
                scatter(ux, uy, uz, g, there, table_out, resolutions, offsets, first, active, FEATURES)
            if places_out is not None:
                ax, ay, az = slope(ux, uy, uz, g, there, table, resolutions, offsets, first, active, FEATURES)
                gx, gy, gz = gx + ax, gy + ay, gz + az
        tl.store(weights_out + at, to_weight * divided, mask=there)
        if places_out is not None:
            gx, gy, gz = to_frame(x, y, z, gx, gy, gz, scale)
            gx, gy, gz = back_to_world(px, py, pz, gx, gy, gz, CONTRACTED)
            tl.store(places_out + at, gx, mask=there)
            tl.store(places_out + plane + at, gy, mask=there)
            tl.store(places_out + 2 * plane + at, gz, mask=there)
