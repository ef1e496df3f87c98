"""What a LiDAR makes of true ranges: noise, beams that come to nothing, and what differs from flight to flight."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from imagine.core.config import Settings
from imagine.core.lidar import LidarSpec
from imagine.sim.keyed_noise import LARGEST_DEVIATE, key_of, scramble

_PATCH_M = 0.5
_LOSSES, _PATCHES = 1, 2  # what keys are drawn for, besides the noise
_ROW = 9
STD, STD_PER_M, RANGE_MIN, RANGE_MAX, DROPOUT, DROPPED, MISSES, DARK_SHARE, DARK_RANGE = range(_ROW)
"""Columns of a world's row of sensor numbers."""


class LidarModel(Settings):
    """How far a simulated LiDAR is from ideal. By default its only fault is the sensor's own range noise."""

    noise_std_m: float | None = Field(default=None, ge=0.0, le=1.0, description="range noise; None: the sensor's own")
    noise_per_m: float = Field(default=0.0, ge=0.0, le=0.1, description="what the noise grows by for each metre")
    noise_scale: tuple[float, float] = Field(
        default=(1.0, 1.0), description="all noise is scaled by a number drawn from here for every episode"
    )
    dropout: tuple[float, float] = Field(
        default=(0.0, 0.0), description="share of beams lost for no reason, drawn from here for every episode"
    )
    dropout_invalid: bool = Field(default=True, description="lost beams read invalid (nan), not no return (inf)")
    miss_at_max: float = Field(
        default=0.0, ge=0.0, le=1.0, description="share of beams without return at the greatest range; grows as r²"
    )
    dark_share: float = Field(default=0.0, ge=0.0, le=1.0, description="share of 0.5 m patches of wall that are dark")
    dark_range_m: float = Field(default=2.0, gt=0.0, description="dark patches give no return from further away")
    skew: bool = Field(default=False, description="beams are taken one after another while the drone moves")

    @model_validator(mode="after")
    def _ordered(self) -> LidarModel:
        for name, (low, high), most in (("noise_scale", self.noise_scale, 10.0), ("dropout", self.dropout, 1.0)):
            if not 0.0 <= low <= high <= most:
                raise ValueError(f"{name}: give lowest and highest within 0 and {most:g}, lowest first")
        return self


def sensor_numbers(
    model: LidarModel, spec: LidarSpec, generator: np.random.Generator | None = None
) -> NDArray[np.float64]:
    """Return the numbers of one world's sensors for an episode, `[9]`, columns as named in this module.

    What a model leaves open is drawn from the generator; without one it is the middle.
    """
    scale, dropout = ((low + high) / 2.0 for low, high in (model.noise_scale, model.dropout))
    if generator is not None:
        scale, dropout = generator.uniform(*model.noise_scale), generator.uniform(*model.dropout)
    row = np.empty(_ROW)
    row[STD] = scale * (spec.noise_std if model.noise_std_m is None else model.noise_std_m)
    row[STD_PER_M] = scale * model.noise_per_m
    row[RANGE_MIN], row[RANGE_MAX] = spec.range_min, spec.range_max
    row[DROPOUT], row[DROPPED] = dropout, math.nan if model.dropout_invalid else math.inf
    row[MISSES] = model.miss_at_max / spec.range_max**2
    row[DARK_SHARE], row[DARK_RANGE] = model.dark_share, model.dark_range_m
    return row


@numba.njit(cache=True, nogil=True)
def cast_limit(numbers, reach):  # type: ignore[no-untyped-def]
    """Return how far to look, metres, so that noise can bring nothing from beyond to within `reach`."""
    share = 1.0 - LARGEST_DEVIATE * numbers[STD_PER_M]
    if share <= 0.0:
        return numbers[RANGE_MAX]
    return min(numbers[RANGE_MAX], (reach + LARGEST_DEVIATE * numbers[STD]) / share + 1e-6)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def measure(ranges, inverse, limit, reach, numbers, normal, key):  # type: ignore[no-untyped-def]
    """Fill `ranges` (float32 `[beams]`) from inverse true ranges: noise added, inf past `reach`, nan if too near.

    `inverse` at or below 1 / `limit` met nothing. The noise is a function of `key` (uint64) and beam alone.
    """
    beams = len(ranges)
    std, per_m, range_min = numbers[STD], numbers[STD_PER_M], numbers[RANGE_MIN]
    furthest = min(reach, numbers[RANGE_MAX])
    floor = 1.0 / limit
    for group in range((beams + 3) // 4):
        bits = key_of(key, group)
        for beam in range(4 * group, min(4 * group + 4, beams)):
            r = np.inf
            if inverse[beam] > floor:
                r = 1.0 / inverse[beam]
                r += (std + per_m * r) * normal[bits & np.uint64(0xFFFF)]
                if r > furthest:
                    r = np.inf
                elif r < range_min:
                    r = np.nan
            ranges[beam] = r
            bits >>= np.uint64(16)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def lose_beams(ranges, inverse, numbers, key):  # type: ignore[no-untyped-def]
    """Take away beams (`ranges` float32 `[beams]`, in place) that are dropped, or too far from what they hit."""
    dropout, dropped, misses = numbers[DROPOUT], numbers[DROPPED], numbers[MISSES]
    own = key_of(key, -_LOSSES)
    for beam in range(len(ranges)):
        chance = np.float64(key_of(own, beam) >> np.uint64(11)) / 9007199254740992.0
        if chance < dropout:
            ranges[beam] = dropped
        elif np.isfinite(ranges[beam]):
            r = 1.0 / inverse[beam]
            if chance < dropout + (1.0 - dropout) * misses * r * r:
                ranges[beam] = np.inf


@numba.njit(cache=True, nogil=True, error_model="numpy")
def darken(ranges, inverse, table, pose, heading, numbers, world_key):  # type: ignore[no-untyped-def]
    """Take away returns (`ranges` float32 `[beams]`, in place) from dark patches that are too far away.

    Dark are squares of 0.5 m of the map, the same as long as the world's key is: a wall does not change its colour.
    """
    c, s = math.cos(heading), math.sin(heading)
    own = key_of(world_key, -_PATCHES)
    for beam in range(len(ranges)):
        r = 1.0 / inverse[beam]
        if not np.isfinite(ranges[beam]) or r <= numbers[DARK_RANGE]:
            continue
        ux, uy = c * table[0, beam] - s * table[1, beam], s * table[0, beam] + c * table[1, beam]
        column, row = math.floor((pose[0] + r * ux) / _PATCH_M), math.floor((pose[1] + r * uy) / _PATCH_M)
        bits = scramble(key_of(key_of(own, column), row))
        if np.float64(bits >> np.uint64(11)) / 9007199254740992.0 < numbers[DARK_SHARE]:
            ranges[beam] = np.inf
