"""A binary range coder in whole numbers: bits with their probabilities into bytes, and back, alike on every machine.

The coder of Martin (1979) in the byte-wise form that LZMA made common. What a model says is a list of steps, each
`2 context + bit`; a table holds for each context the chance that its bit is zero, of 65536 (`ONE`). Context 0 is even
odds always. With `learns` the table follows what was seen. A decoder's state is (code, range, place in the bytes),
handed on as numbers so that they stay in registers. Behind the last byte a decoder reads zeros, so an encoder drops
zeros at the end. What damaged bytes decode to is some other content: integrity is the seal's business.
"""

from __future__ import annotations

import numba
import numpy as np

ONE = 1 << 16
LEAST = 32
"""Chances are from 32 to 65504 of 65536: no bit costs less than 0.0007 bits, none more than 11."""
LEARNING_SHIFT = 5
"""A chance that is learnt goes 1/32 of the way to what was just seen."""
LONGEST_BITS = 40
"""A number is below 2^40 - 1: with one added it has at most so many digits."""
NUMBER_CONTEXTS = 2 * LONGEST_BITS
"""How many contexts one kind of number takes."""
MOST_NUMBER_STEPS = 2 * LONGEST_BITS
"""How many steps one number takes at most."""
_TOP = 1 << 24
_WORD = 1 << 32
_WORD_MASK = _WORD - 1


@numba.njit(cache=True, nogil=True)
def _learnt(zero, bit):  # type: ignore[no-untyped-def]
    """Return a chance of zero moved toward the bit that was seen."""
    if bit == 0:
        return min(zero + ((ONE - zero) >> LEARNING_SHIFT), ONE - LEAST)
    return max(zero - (zero >> LEARNING_SHIFT), LEAST)


@numba.njit(cache=True, nogil=True)
def _carry(out, at):  # type: ignore[no-untyped-def]
    """Add one to the bytes before `at`."""
    at -= 1
    while out[at] == 255:
        out[at] = 0
        at -= 1
    out[at] += 1


@numba.njit(cache=True, nogil=True)
def encode_steps(steps, count, zeros, learns, out):  # type: ignore[no-untyped-def]
    """Write the first `count` of `steps` into `out` (uint8); return how many bytes that takes, or -1 if it is full.

    `zeros` int64, the chances of zero by context; they change as they learn.
    """
    low, span, place = 0, _WORD_MASK, 0
    for k in range(count):
        step = np.int64(steps[k])
        context, bit = step >> 1, step & 1
        zero = zeros[context]
        bound = (span * zero) >> 16
        if bit == 0:
            span = bound
        else:
            low += bound
            span -= bound
            if low >= _WORD:
                low -= _WORD
                _carry(out, place)
        if learns and context > 0:
            zeros[context] = _learnt(zero, bit)
        while span < _TOP:
            if place + 5 > len(out):
                return -1
            out[place] = low >> 24
            place += 1
            low = (low << 8) & _WORD_MASK
            span <<= 8
    return _finish(out, place, low, span)


@numba.njit(cache=True, nogil=True)
def _finish(out, place, low, span):  # type: ignore[no-untyped-def]
    """Write the fewest bytes of a number in [low, low + span); return how many bytes there are, zeros dropped."""
    for count in range(5):
        mask = (_WORD >> (8 * count)) - 1
        value = (low + mask) & ~mask
        if value < low + span:
            if value >= _WORD:
                value -= _WORD
                _carry(out, place)
            for _ in range(count):
                out[place] = value >> 24
                place += 1
                value = (value << 8) & _WORD_MASK
            break
    while place > 0 and out[place - 1] == 0:
        place -= 1
    return place


@numba.njit(cache=True, nogil=True)
def start_decoder(data):  # type: ignore[no-untyped-def]
    """Return the state of a decoder at the beginning of `data`, uint8."""
    code = np.int64(0)
    for at in range(4):
        code = (code << 8) | (np.int64(data[at]) if at < len(data) else np.int64(0))
    return code, np.int64(_WORD_MASK), np.int64(4)


@numba.njit(cache=True, nogil=True)
def decode_bit(data, state, zero):  # type: ignore[no-untyped-def]
    """Return the next bit, whose chance of being zero is `zero` of `ONE`, and the state after it."""
    code, span, place = state
    bound = (span * zero) >> 16
    if code < bound:
        span = bound
        bit = np.int64(0)
    else:
        code -= bound
        span -= bound
        bit = np.int64(1)
    while span < _TOP:
        code <<= 8
        if place < len(data):
            code |= np.int64(data[np.uint64(place)])
        place += 1
        span <<= 8
    return bit, (code, span, place)


@numba.njit(cache=True, nogil=True)
def decode_learnt(data, state, zeros, context):  # type: ignore[no-untyped-def]
    """Return the next bit, by the chance `zeros[context]`, which learns, and the state; for contexts from 1 on."""
    zero = zeros[np.uint64(context)]
    bit, state = decode_bit(data, state, zero)
    zeros[np.uint64(context)] = _learnt(zero, bit)
    return bit, state


@numba.njit(cache=True, nogil=True)
def is_used_up(data, state):  # type: ignore[no-untyped-def]
    """Tell whether a decoder that has read its last bit has no bytes left over."""
    return len(data) <= state[2]


@numba.njit(cache=True, nogil=True)
def has_only_zeros_left(data, state):  # type: ignore[no-untyped-def]
    """Tell whether what a decoder has not read of `data` are zeros, if anything."""
    for at in range(state[2], len(data)):  # numba compiles no generators  # noqa: SIM110
        if data[at] != 0:
            return False
    return True


@numba.njit(cache=True, nogil=True)
def number_steps(value, first, steps, at):  # type: ignore[no-untyped-def]
    """Write the steps of a number, 0 to 2^40 - 2, into `steps` from `at`; return the place after them.

    The gamma code of Elias (1975) of the number plus one: how often it can be halved, as so many ones and a zero, by
    the contexts from `first` on (the longest has no zero); then its digits below the leading one, highest first, of
    which the first has contexts by the length, `LONGEST_BITS` further on, and the others even odds.
    """
    length, rest = 0, (value + 1) >> 1
    while rest > 0:
        rest >>= 1
        steps[at] = 2 * (first + length) + 1
        at += 1
        length += 1
    if length < LONGEST_BITS - 1:
        steps[at] = 2 * (first + length)
        at += 1
    for k in range(length - 1, -1, -1):
        context = first + LONGEST_BITS + length if k == length - 1 else 0
        steps[at] = 2 * context + (((value + 1) >> k) & 1)
        at += 1
    return at


@numba.njit(cache=True, nogil=True)
def decode_number(data, state, zeros, first):  # type: ignore[no-untyped-def]
    """Return a number that was written as `number_steps`, by chances that learn, and the state after it."""
    length, more = np.int64(0), np.int64(1)
    while length < LONGEST_BITS - 1:
        more, state = decode_learnt(data, state, zeros, first + length)
        if more == 0:
            break
        length += 1
    value = np.int64(1)
    for k in range(length - 1, -1, -1):
        if k == length - 1:
            bit, state = decode_learnt(data, state, zeros, first + LONGEST_BITS + length)
        else:
            bit, state = decode_bit(data, state, ONE // 2)
        value = (value << 1) | bit
    return value - 1, state
