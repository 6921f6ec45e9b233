"""Rays through the cells of the occupancy grid on the CPU: many of them a cell further at once, as vectors.

What is known of a ray under way lies in a lane of an array on the stack, which has a part of ``LANES`` numbers for each quantity. All cells
are found, then all states read, and only then does anything depend on one: to read a state from beyond the nearest caches takes as long as
a hundred instructions, and the processor reads many at once unless it has to guess what comes of one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import (
    ALONG_FACE,
    FACE_OVERSHOOT,
    LEAST_ADVANCE,
    LONGEST_STEP,
    NO_CROSSING,
    OUTSIDE,
)
from mmsynth.field.kernels.cpu.jit import inlined, part
from mmsynth.field.kernels.cpu.matrices import whole
from mmsynth.field.kernels.cpu.stack import on_stack

LANES = 128
_L, _VECTOR = LANES, 16  # numbers in a vector
# parts of an array: of a ray; how far along it, the distance by which it enters a shell behind a free cell, else 0; then what is found:
# position, velocity, distance from the centre, speed, cell, its state
ORIGIN, DIRECTION, TIME, ENTERS, PLACE, _VELOCITY, REACH, SPEED, _CELL, STATE = 0, 3, 6, 7, 8, 11, 14, 15, 16, 19
of_lanes, _cells = on_stack(types.float32, 20 * LANES), on_stack(types.int32, LANES)
_f = np.float32
_ZERO, _ONE, _TWO, _ALL = _f(0.0), _f(1.0), _f(2.0), _f(np.inf)
_LONGEST, _LEAST_ADVANCE, _NO_CROSSING = _f(LONGEST_STEP), _f(LEAST_ADVANCE), _f(NO_CROSSING)
_FACE_OVERSHOOT, _ALONG_FACE, _OUTSIDE = _f(FACE_OVERSHOOT), _f(ALONG_FACE), _f(OUTSIDE)


@inlined()
def _contraction(x, y, z, border):  # type: ignore[no-untyped-def]
    """See ``marching.contract``: distance from the centre, one over it, factor of the position; 1 within the border."""
    square = x * x + y * y + z * z
    r = _f(math.sqrt(square)) if square > border else _ONE
    inverse = _ONE / r
    return r, inverse, (_TWO - inverse) * inverse


@inlined()
def _to_face(cell, place, velocity, width, extent):  # type: ignore[no-untyped-def]
    """How long until the next face of a cell across an axis."""
    face = (cell + (_ONE if velocity > _ZERO else _ZERO)) * width - extent
    return (face - place) / velocity if abs(velocity) > _ALONG_FACE else _NO_CROSSING


@part()
def go_on(n, of, states, extent, step):  # type: ignore[no-untyped-def]
    """From ``TIME`` of n lanes to where a surface may be: they stay there, or where they enter its shell; or, with the state of a free
    cell, to behind that cell. ``PLACE`` is where they are then, ``REACH`` and ``SPEED`` (of contraction: mip-NeRF 360, eq. 10) where they
    were."""
    grid, lanes, cells = states.shape[0], whole(n, _VECTOR), _cells()
    flat, last = states.reshape(grid * grid * grid), _f(grid - 1)
    half, width = _f(0.5 * grid / extent), _f(2.0 * extent / grid)
    border, longest = (_ONE, _LONGEST) if extent > _ONE else (_ALL, _ALL)
    for i in range(lanes):
        dx, dy, dz, t = of[DIRECTION * _L + i], of[(DIRECTION + 1) * _L + i], of[(DIRECTION + 2) * _L + i], of[TIME * _L + i]
        x, y, z = of[ORIGIN * _L + i] + dx * t, of[(ORIGIN + 1) * _L + i] + dy * t, of[(ORIGIN + 2) * _L + i] + dz * t
        r, inverse, k = _contraction(x, y, z, border)
        along = (x * dx + y * dy + z * dz) * inverse
        radial = along * (inverse * inverse - k) * inverse
        # from the parts along the radius and across it: 1 - along² would be rounding alone far away
        along *= inverse
        px, py, pz = dx - x * along, dy - y * along, dz - z * along
        outward = along * inverse
        speed = _f(math.sqrt(k * k * (px * px + py * py + pz * pz) + outward * outward))
        cx, cy, cz = x * k, y * k, z * k
        ix = np.int32(min(max((cx + extent) * half, _ZERO), last))
        iy = np.int32(min(max((cy + extent) * half, _ZERO), last))
        iz = np.int32(min(max((cz + extent) * half, _ZERO), last))
        of[PLACE * _L + i], of[(PLACE + 1) * _L + i], of[(PLACE + 2) * _L + i] = cx, cy, cz
        of[_VELOCITY * _L + i] = dx * k + x * radial
        of[(_VELOCITY + 1) * _L + i] = dy * k + y * radial
        of[(_VELOCITY + 2) * _L + i] = dz * k + z * radial
        of[REACH * _L + i], of[SPEED * _L + i] = r, speed if r > _ONE else _ONE
        of[_CELL * _L + i], of[(_CELL + 1) * _L + i], of[(_CELL + 2) * _L + i] = _f(ix), _f(iy), _f(iz)
        cells[i] = (ix * np.int32(grid) + iy) * np.int32(grid) + iz
    for i in range(n):
        of[STATE * _L + i] = _f(flat[cells[i]])
    for i in range(lanes):
        dx, dy, dz, t = of[DIRECTION * _L + i], of[(DIRECTION + 1) * _L + i], of[(DIRECTION + 2) * _L + i], of[TIME * _L + i]
        cx, cy, cz = of[PLACE * _L + i], of[(PLACE + 1) * _L + i], of[(PLACE + 2) * _L + i]
        r, speed, state = of[REACH * _L + i], of[SPEED * _L + i], of[STATE * _L + i]
        leave = min(
            _to_face(of[_CELL * _L + i], cx, of[_VELOCITY * _L + i], width, extent),
            _to_face(of[(_CELL + 1) * _L + i], cy, of[(_VELOCITY + 1) * _L + i], width, extent),
            _to_face(of[(_CELL + 2) * _L + i], cz, of[(_VELOCITY + 2) * _L + i], width, extent),
        )
        # the cell's certificate may reach beyond it
        leave = max(min(leave, _NO_CROSSING), (state - _OUTSIDE) / (half * speed * _TWO)) + _FACE_OVERSHOOT * step / speed
        behind = max(t + min(leave, longest * r), t * _LEAST_ADVANCE)
        # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
        entered = t + of[ENTERS * _L + i] / speed
        x, y, z = of[ORIGIN * _L + i] + dx * entered, of[(ORIGIN + 1) * _L + i] + dy * entered, of[(ORIGIN + 2) * _L + i] + dz * entered
        _, _, k = _contraction(x, y, z, border)
        of[PLACE * _L + i], of[(PLACE + 1) * _L + i], of[(PLACE + 2) * _L + i] = x * k, y * k, z * k
        of[TIME * _L + i] = behind if state >= _OUTSIDE else entered
