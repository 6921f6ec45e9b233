"""Sections between the samples of rays in Triton: their weights, the surfaces that they make, and the gradients of both.

One ray per lane, from its first sample to its last. Sections that matter are listed: the columns of (MAX_SAMPLES, R) arrays.
"""

from __future__ import annotations

from mmsynth.field.kernels.cuda.shared import LAYER_GAP, LEAST_WEIGHT, MAX_SAMPLES, contracted, jit, position, tl


@jit
def _is_dense(tau):  # type: ignore[no-untyped-def]
    """Sections of less are passed over."""
    return ~(tau < 1e-7)  # NaN is


@jit
def _opacity(tau):  # type: ignore[no-untyped-def]
    """1 - e^-τ for τ >= 0; Triton has no expm1 of its own: its series below 0.05, exact to 3e-9."""
    return tl.where(tau < 0.05, tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0 - tau * (1.0 / 24.0 - tau / 120.0)))), 1.0 - tl.exp(-tau))


@jit
def weigh_kernel(  # type: ignore[no-untyped-def]
    origins, directions, found, counts, sharpness_at, sections, section_k, section_count, second, touched, share, shown, distance, depth,
    opacity, behind, samples, rays, min_section_weight, max_optical_depth, CONTRACTED: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Weights of sections, see ``reference.section_weights`` and ``composite``.

    sections: (2, MAX_SAMPLES, rays) of those that matter: ray distance where they cross the surface, weight; section_k: the samples with
    which they begin. section_count, second, touched: (rays,) int32: how many matter, the sample with which the second surface begins
    (MAX_SAMPLES: none), how many samples have a gradient. share, shown, distance: (2 rays,). depth, opacity, behind: (rays,). samples: of
    all rays, added to what is there.
    """
    ray = tl.program_id(0) * LANES + tl.arange(0, LANES)
    live = ray < rays
    plane = rays * MAX_SAMPLES
    gap = (1.0 / tl.load(sharpness_at) * LAYER_GAP).to(tl.float32)
    count = tl.load(counts + ray, mask=live, other=0)
    ox, oy, oz = position(origins, ray, live)
    dx, dy, dz = position(directions, ray, live)
    zero = tl.zeros([LANES], tl.float32)
    none = zero.to(tl.int32)
    passed, before, nearest, half = zero, zero, zero - 1.0, zero + float("nan")
    shown0, shown1, far0, far1 = zero, zero, zero, zero
    lx, ly, lz = zero, zero, zero
    listed, touching, begins = none, none, none + MAX_SAMPLES
    was_dense = live & (count < 0)
    t0 = tl.load(found + ray, mask=live & (count > 0), other=0.0)
    f0 = tl.load(found + plane + ray, mask=live & (count > 0), other=0.0)
    for k in range(0, tl.max(count, 0) - 1):
        there = k + 1 < count
        at = found + (k + 1) * rays + ray
        t1 = tl.load(at, mask=there, other=0.0)
        f1 = tl.load(at + plane, mask=there, other=0.0)
        tau = tl.load(at + 2 * plane, mask=there, other=0.0)
        dense = there & _is_dense(tau)
        w = tl.exp(-passed) * _opacity(tau)
        passed = tl.where(dense, passed + tau, passed)
        # the ray was ended here: what is left belongs to this surface, too
        w = tl.where(dense, tl.where(passed > max_optical_depth, w + tl.exp(-passed), w), 0.0)
        crosses = (f0 > 0.0) & (f1 <= 0.0)
        # a ray that begins behind a surface meets it there
        middle = tl.where((f0 < 0.0) & (k == 0), 0.0, 0.5)
        t = t0 + tl.where(crosses, f0 / tl.where(crosses, f0 - f1, 1.0), middle) * (t1 - t0)
        half = tl.where(dense & (before < 0.5) & (before + w >= 0.5), t, half)
        matters = dense & (w > min_section_weight)
        x, y, z, _ = contracted(ox + dx * t, oy + dy * t, oz + dz * t, CONTRACTED)
        apart = tl.sqrt((x - lx) * (x - lx) + (y - ly) * (y - ly) + (z - lz) * (z - lz)) > gap
        starts = matters & (listed > 0) & (nearest < 0.0) & apart
        nearest = tl.where(starts, before, nearest)
        begins = tl.where(starts, k, begins)
        lx, ly, lz = tl.where(matters, x, lx), tl.where(matters, y, ly), tl.where(matters, z, lz)
        to = sections + listed * rays + ray
        tl.store(to, t, mask=matters)
        tl.store(to + plane, w, mask=matters)
        tl.store(section_k + listed * rays + ray, k + none, mask=matters)
        listed += matters.to(tl.int32)
        front, rear = matters & (nearest < 0.0), matters & (nearest >= 0.0)
        shown0, shown1 = tl.where(front, shown0 + w, shown0), tl.where(rear, shown1 + w, shown1)
        far0, far1 = tl.where(front, far0 + w * t, far0), tl.where(rear, far1 + w * t, far1)
        # a sample has a gradient where a section begins or ends that is dense
        touching += tl.where(dense, tl.where(was_dense, 1, 2), 0)
        was_dense = dense
        before += w
        t0, f0 = t1, f1
    two = nearest >= 0.0
    tl.store(section_count + ray, listed, mask=live)
    tl.store(second + ray, begins, mask=live)
    tl.store(touched + ray, touching, mask=live)
    tl.store(share + ray, tl.where(two, nearest, before), mask=live)
    tl.store(share + rays + ray, tl.where(two, before - nearest, 0.0), mask=live)
    tl.store(shown + ray, tl.maximum(shown0, LEAST_WEIGHT), mask=live)
    tl.store(shown + rays + ray, tl.maximum(shown1, LEAST_WEIGHT), mask=live)
    tl.store(distance + ray, far0 / tl.maximum(shown0, LEAST_WEIGHT), mask=live)
    tl.store(distance + rays + ray, far1 / tl.maximum(shown1, LEAST_WEIGHT), mask=live)
    tl.store(depth + ray, half, mask=live)
    tl.store(opacity + ray, before, mask=live)
    tl.store(behind + ray, tl.where(two, rays + ray, -1).to(tl.int64), mask=live)
    tl.atomic_add(samples, tl.sum(count, 0), sem="relaxed")


@jit
def weigh_backward_kernel(  # type: ignore[no-untyped-def]
    found, counts, sharpness_at, section_k, section_count, second, ends, touched, g_section, g_share, g_opacity,
    ray_out, time_out, out, rays, LANES: tl.constexpr,
):  # fmt: skip
    """Gradients of the distances at samples, packed ray after ray: those of the samples that have one.

    dL/df of a sample is s σ(-s f) (dL/dτ of the section it starts - dL/dτ of the one it ends), and dL/dτᵢ = gᵢ Tᵢ e^-τᵢ - Σ_{j>i} gⱼ wⱼ,
    the sum being the ray's total less what has passed: one pass for the total, one for the rest.

    ends: (rays,) int64, cumulated sum of ``touched``. g_section: (MAX_SAMPLES, rays) of the weights of sections that matter.
    """
    ray = tl.program_id(0) * LANES + tl.arange(0, LANES)
    live = ray < rays
    plane = rays * MAX_SAMPLES
    sharpness = tl.load(sharpness_at)
    count = tl.load(counts + ray, mask=live, other=0)
    listed = tl.load(section_count + ray, mask=live, other=0)
    begins = tl.load(second + ray, mask=live, other=0)
    zero = tl.zeros([LANES], tl.float32)
    base0, base1 = zero, zero
    if g_share is not None:
        base0 += tl.load(g_share + ray, mask=live, other=0.0)
        base1 += tl.load(g_share + rays + ray, mask=live, other=0.0)
    if g_opacity is not None:
        base0 += tl.load(g_opacity + ray, mask=live, other=0.0)
        base1 += tl.load(g_opacity + ray, mask=live, other=0.0)
    longest = tl.max(count, 0) - 1
    total, passed, j = zero, zero, zero.to(tl.int32)
    next_k = tl.load(section_k + ray, mask=live & (listed > 0), other=-1)
    for k in range(0, longest):
        there = k + 1 < count
        tau = tl.load(found + 2 * plane + (k + 1) * rays + ray, mask=there, other=0.0)
        dense = there & _is_dense(tau)
        matters = dense & (k == next_k)
        g = tl.where(k < begins, base0, base1)
        if g_section is not None:
            g += tl.load(g_section + j * rays + ray, mask=matters, other=0.0)
        total += tl.where(dense, g * tl.exp(-passed) * _opacity(tau), 0.0)
        passed = tl.where(dense, passed + tau, passed)
        j += matters.to(tl.int32)
        next_k = tl.where(matters, tl.load(section_k + j * rays + ray, mask=matters & (j < listed), other=-1), next_k)
    slot = (tl.load(ends + ray, mask=live, other=0) - tl.load(touched + ray, mask=live, other=0)).to(tl.int32)
    passed, j = zero, zero.to(tl.int32)
    next_k = tl.load(section_k + ray, mask=live & (listed > 0), other=-1)
    f0 = tl.load(found + plane + ray, mask=live & (count > 0), other=0.0)
    t0 = tl.load(found + ray, mask=live & (count > 0), other=0.0)
    ending, was_dense = zero, live & (count < 0)
    for k in range(0, longest + 1):  # the last round has no section, and the gradient of the last sample
        there = k + 1 < count
        at = found + (k + 1) * rays + ray
        t1 = tl.load(at, mask=there, other=0.0)
        f1 = tl.load(at + plane, mask=there, other=0.0)
        tau = tl.load(at + 2 * plane, mask=there, other=0.0)
        dense = there & _is_dense(tau)
        matters = dense & (k == next_k)
        g = tl.where(k < begins, base0, base1)
        if g_section is not None:
            g += tl.load(g_section + j * rays + ray, mask=matters, other=0.0)
        transmittance = tl.exp(-passed)
        total = tl.where(dense, total - g * transmittance * _opacity(tau), total)
        of_tau = tl.where(dense, g * transmittance * tl.exp(-tau) - total, 0.0)
        met = dense | was_dense
        e = tl.exp(-tl.abs(sharpness * f0.to(tl.float64)))
        slope = sharpness * (tl.where(f0 <= 0.0, 1.0, e) / (1.0 + e))
        begins_behind = (f0 < 0.0) & (k == 0)  # then of the end that is deeper
        here = tl.where(begins_behind, tl.where(f0 < f1, -of_tau, 0.0), of_tau)
        tl.store(out + slot, (slope * (here - ending).to(tl.float64)).to(tl.float32), mask=met)
        tl.store(time_out + slot, t0, mask=met)
        tl.store(ray_out + slot, ray, mask=met)
        slot += met.to(tl.int32)
        passed = tl.where(dense, passed + tau, passed)
        ending, was_dense = tl.where(begins_behind & (f0 < f1), 0.0, of_tau), dense
        j += matters.to(tl.int32)
        next_k = tl.where(matters, tl.load(section_k + j * rays + ray, mask=matters & (j < listed), other=-1), next_k)
        t0, f0 = t1, f1


@jit
def rays_backward_kernel(  # type: ignore[no-untyped-def]
    ends, touched, times, of_samples, sections, section_count, of_sections, origins_out, directions_out, rays, LANES: tl.constexpr
):
    """Gradients of rays from those of their samples' places (packed, 3) and their sections' (3, MAX_SAMPLES, rays), or None."""
    ray = tl.program_id(0) * LANES + tl.arange(0, LANES)
    live = ray < rays
    plane = rays * MAX_SAMPLES
    zero = tl.zeros([LANES], tl.float32)
    ox, oy, oz, dx, dy, dz = zero, zero, zero, zero, zero, zero
    count = tl.load(touched + ray, mask=live, other=0)
    begin = (tl.load(ends + ray, mask=live, other=0) - count).to(tl.int32)
    for k in range(0, tl.max(count, 0)):
        there = k < count
        gx, gy, gz = position(of_samples, begin + k, there)
        t = tl.load(times + begin + k, mask=there, other=0.0)
        ox, oy, oz, dx, dy, dz = ox + gx, oy + gy, oz + gz, dx + gx * t, dy + gy * t, dz + gz * t
    if of_sections is not None:
        count = tl.load(section_count + ray, mask=live, other=0)
        for j in range(0, tl.max(count, 0)):
            there = j < count
            at = j * rays + ray
            gx = tl.load(of_sections + at, mask=there, other=0.0)
            gy = tl.load(of_sections + plane + at, mask=there, other=0.0)
            gz = tl.load(of_sections + 2 * plane + at, mask=there, other=0.0)
            t = tl.load(sections + at, mask=there, other=0.0)
            ox, oy, oz, dx, dy, dz = ox + gx, oy + gy, oz + gz, dx + gx * t, dy + gy * t, dz + gz * t
    tl.store(origins_out + 3 * ray, ox, mask=live)
    tl.store(origins_out + 3 * ray + 1, oy, mask=live)
    tl.store(origins_out + 3 * ray + 2, oz, mask=live)
    tl.store(directions_out + 3 * ray, dx, mask=live)
    tl.store(directions_out + 3 * ray + 1, dy, mask=live)
    tl.store(directions_out + 3 * ray + 2, dz, mask=live)
