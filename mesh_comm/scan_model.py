"""How likely a scan's ranges are, beam after beam: what the range coder packs a scan by.

A beam's code is 0 invalid, 1 no return, or a range in steps plus 2. Whether a beam differs in kind (invalid, no
return, hit) from the beam before, and which of the other two it is, have contexts by the kinds of the two beams before.
A hit is told as what it is off a prediction: walls are smooth and the sensor is not, so a filter of place and slope
(alpha-beta, Kalata 1984) follows the hits, in 1/16 steps, and starts anew where a hit is far off. Size and sign of the
difference have contexts by the sizes of the two differences before it. The chances learn as the scan goes, for sensors
differ.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.mesh_comm.range_coder import (
    MOST_NUMBER_STEPS,
    NUMBER_CONTEXTS,
    decode_learnt,
    decode_number,
    is_used_up,
    number_steps,
    start_decoder,
)

INVALID, NO_RETURN, FIRST_RANGE = 0, 1, 2
_HIT = 2
_ROUGHNESSES = 7
_AFTER_GAP = _ROUGHNESSES  # the first hit behind beams without one
KINDS = 1
"""Where the contexts of kinds begin, by the kind of the beam before, of that before it, and by which of two bits."""
SIGNS = KINDS + 18
"""... of "is below the prediction", by roughness and the sign of the difference before (0 none, 1 above, 2 below)."""
SIZES = SIGNS + 3 * (_ROUGHNESSES + 1)
"""... of the sizes of differences, by roughness."""
SCAN_CONTEXTS = SIZES + (_ROUGHNESSES + 1) * NUMBER_CONTEXTS
MOST_BEAM_STEPS = 3 + MOST_NUMBER_STEPS
_FRACTION = 4  # digits after the point in place and slope
_PLACE_SHIFT, _SLOPE_SHIFT = 1, 2  # alpha 1/2, beta 1/4: the best of eight pairs on flights in the twin
_FAR = 8  # steps off: another wall


@numba.njit(cache=True, nogil=True)
def _roughness(last, before):  # type: ignore[no-untyped-def]
    """Return how rough it was: the digits of the sum of the two differences' sizes, at most 6."""
    total, digits = last + before, 0
    while total > 0 and digits < _ROUGHNESSES - 1:
        total >>= 1
        digits += 1
    return digits


@numba.njit(cache=True, nogil=True)
def _follow(track, difference, code):  # type: ignore[no-untyped-def]
    """Take the hit `code` into `track`: place and slope in 1/16 steps, then size, size before, and sign."""
    if abs(difference) > _FAR:
        track[0], track[1] = code << _FRACTION, 0
    else:
        off = difference << _FRACTION
        track[0] += track[1] + (off >> _PLACE_SHIFT)
        track[1] += off >> _SLOPE_SHIFT
    track[3], track[2] = track[2], abs(difference)
    track[4] = 0 if difference == 0 else (1 if difference > 0 else 2)


@numba.njit(cache=True, nogil=True)
def _prediction(track, most):  # type: ignore[no-untyped-def]
    """Return the code that the next hit should have."""
    rounded = (track[0] + track[1] + (1 << (_FRACTION - 1))) >> _FRACTION
    return min(max(rounded, FIRST_RANGE), most)


@numba.njit(cache=True, nogil=True)
def scan_steps(codes, most, steps):  # type: ignore[no-untyped-def]
    """Write the steps that tell `codes` (int64 `[beams]`, at most `most`) into `steps`; return how many.

    `steps` int16 `[MOST_BEAM_STEPS * beams]`.
    """
    track = np.zeros(5, np.int64)
    track[0] = most << _FRACTION
    at, before, last, is_hit = 0, _HIT, _HIT, False
    for beam in range(len(codes)):
        code = codes[beam]
        kind = min(code, _HIT)
        context = KINDS + 2 * (3 * last + before)
        steps[at] = 2 * context + (1 if kind != last else 0)
        at += 1
        if kind != last:
            lower = 1 if last == 0 else 0
            steps[at] = 2 * (context + 1) + (0 if kind == lower else 1)
            at += 1
        if kind == _HIT:
            difference = code - _prediction(track, most)
            rough = _roughness(track[2], track[3]) if is_hit else _AFTER_GAP
            at = number_steps(abs(difference), SIZES + rough * NUMBER_CONTEXTS, steps, at)
            if difference != 0:
                steps[at] = 2 * (SIGNS + 3 * rough + track[4]) + (1 if difference < 0 else 0)
                at += 1
            _follow(track, difference, code)
        before, last, is_hit = last, kind, kind == _HIT
    return at


@numba.njit(cache=True, nogil=True)
def decode_scan(data, zeros, most, codes):  # type: ignore[no-untyped-def]
    """Read `codes` (int64 `[beams]`) from `data` (uint8); return whether all are in bounds and no bytes are left.

    `zeros` int64 `[SCAN_CONTEXTS]` learn. Takes time by the beams whatever the bytes.
    """
    state = start_decoder(data)
    track = np.zeros(5, np.int64)
    track[0] = most << _FRACTION
    before, last, is_hit = _HIT, _HIT, False
    for beam in range(len(codes)):
        context = KINDS + 2 * (3 * last + before)
        kind = last
        is_other, state = decode_learnt(data, state, zeros, context)
        if is_other == 1:
            lower, upper = 1 if last == 0 else 0, 1 if last == 2 else 2
            is_upper, state = decode_learnt(data, state, zeros, context + 1)
            kind = lower if is_upper == 0 else upper
        code = kind
        if kind == _HIT:
            rough = _roughness(track[2], track[3]) if is_hit else _AFTER_GAP
            difference, state = decode_number(data, state, zeros, SIZES + rough * NUMBER_CONTEXTS)
            if difference > most:
                return False
            if difference != 0:
                is_below, state = decode_learnt(data, state, zeros, SIGNS + 3 * rough + track[4])
                difference = -difference if is_below == 1 else difference
            code = _prediction(track, most) + difference
            if code < FIRST_RANGE or code > most:
                return False
            _follow(track, difference, code)
        codes[beam] = code
        before, last, is_hit = last, kind, kind == _HIT
    return is_used_up(data, state)
