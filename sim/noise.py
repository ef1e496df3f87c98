"""Random numbers that are a function of a key, for kernels: what a world draws never depends on what runs beside it."""

from __future__ import annotations

import math

import numba
import numpy as np

_GOLDEN = 0x9E3779B97F4A7C15


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mix(value):  # type: ignore[no-untyped-def]
    """Scramble 64 bits, uint64 to uint64 (the finaliser of splitmix64, Steele et al. 2014)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gauss(key, index):  # type: ignore[no-untyped-def]
    """Return the standard normal number `index` (integer) of the stream `key` (uint64)."""
    a = mix(key + np.uint64(_GOLDEN) * np.uint64(2 * index + 1))
    b = mix(key + np.uint64(_GOLDEN) * np.uint64(2 * index + 2))
    u = (np.float64(a >> np.uint64(11)) + 1.0) / 9007199254740993.0
    v = np.float64(b >> np.uint64(11)) / 9007199254740992.0
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)  # Box and Muller 1958
