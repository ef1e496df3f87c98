"""Random numbers as pure functions of a key, for kernels: no state, so nothing depends on what else runs, or when."""

from __future__ import annotations

import functools

import numba
import numpy as np
from numpy.typing import NDArray

NORMAL_BINS = 65536
"""Entries of the table of normal deviates: one for each value of 16 bits."""
LARGEST_DEVIATE = 4.33
"""No entry of the table lies further out."""

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_SHIFT_A, _SHIFT_B, _SHIFT_C = np.uint64(30), np.uint64(27), np.uint64(31)
_FACTOR_A, _FACTOR_B = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


@functools.cache
def normal_table() -> NDArray[np.float32]:
    """Return the normal distribution's quantiles at the centres of 65536 equal bins, scaled to unit variance.

    Indexed by 16 random bits it is a standard normal deviate, four of them to a hash.
    """
    from scipy.special import ndtri  # here, since the import costs more than the rest of the twin's start

    table = ndtri((np.arange(NORMAL_BINS) + 0.5) / NORMAL_BINS)
    scaled: NDArray[np.float32] = (table / table.std()).astype(np.float32)
    scaled.flags.writeable = False
    return scaled


@numba.njit(cache=True, nogil=True)
def scramble(value):  # type: ignore[no-untyped-def]
    """Scramble 64 bits (the finaliser of splitmix64, Steele et al. 2014)."""
    value = (value ^ (value >> _SHIFT_A)) * _FACTOR_A
    value = (value ^ (value >> _SHIFT_B)) * _FACTOR_B
    return value ^ (value >> _SHIFT_C)


@numba.njit(cache=True, nogil=True)
def key_of(key, number):  # type: ignore[no-untyped-def]
    """Return the key (uint64) that belongs to a number, such as a tick or a drone, under another key."""
    return scramble(key + _GOLDEN * (np.uint64(number) + np.uint64(1)))


def root_keys(seed: int, worlds: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the keys, uint64 `[worlds]`, that all noise of worlds with these numbers is drawn from."""
    keys: NDArray[np.uint64] = _root_keys(np.uint64(seed % 2**64), np.asarray(worlds, np.int64))
    return keys


@numba.njit(cache=True, nogil=True)
def _root_keys(seed, worlds):  # type: ignore[no-untyped-def]
    keys = np.empty(len(worlds), np.uint64)
    for k in range(len(worlds)):
        keys[k] = key_of(scramble(seed), worlds[k])
    return keys
