"""What a LiDAR makes of true ranges: noise, beams that come to nothing, and what differs from flight to flight."""

from __future__ import annotations

import math
from typing import Annotated

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.core.lidar import LidarSpec
from imagine.sim.keyed_noise import LARGEST_DEVIATE, key_of, scramble
from imagine.sim.randomisation import Quantity, draw, ends, positive, within

_PATCH_M = 0.5
_LOSSES, _PATCHES = 1, 2  # what keys are drawn for, besides the noise
_ROW = 9
STD, STD_PER_M, RANGE_MIN, RANGE_MAX, DROPOUT, DROPPED, MISSES, DARK_SHARE, DARK_RANGE = range(_ROW)
"""Columns of a world's row of sensor numbers."""


class LidarModel(Settings):
    """How far a simulated LiDAR is from ideal. By default its only fault is the sensor's own range noise.

    A range [low, high] is drawn from anew for every world and episode; all of a team's LiDARs are alike.
    """

    noise_std_m: Annotated[Quantity, within(0.0, 1.0)] | None = Field(
        default=None, description="range noise, m; None: the sensor's own"
    )
    noise_per_m: Annotated[Quantity, within(0.0, 0.1)] = Field(
        default=0.0, description="what the noise grows by for each metre"
    )
    noise_scale: Annotated[Quantity, within(0.0, 10.0)] = Field(default=1.0, description="what all noise is scaled by")
    dropout: Annotated[Quantity, within(0.0, 1.0)] = Field(default=0.0, description="share of beams lost for no reason")
    dropout_invalid: bool = Field(default=True, description="lost beams read invalid (nan), not no return (inf)")
    miss_at_max: Annotated[Quantity, within(0.0, 1.0)] = Field(
        default=0.0, description="share of beams without return at the greatest range; grows as r²"
    )
    dark_share: Annotated[Quantity, within(0.0, 1.0)] = Field(
        default=0.0, description="share of 0.5 m patches of wall that are dark"
    )
    dark_range_m: Annotated[Quantity, positive()] = Field(
        default=2.0, description="dark patches give no return from further away"
    )
    skew: bool = Field(default=False, description="beams are taken one after another while the drone moves")


def sensor_numbers(
    model: LidarModel, spec: LidarSpec, generator: np.random.Generator | None = None
) -> NDArray[np.float64]:
    """Return the numbers of one world's sensors for an episode, `[9]`, columns as named in this module.

    Ranges are drawn from by the generator; without one it is their middle.
    """
    fields = (
        model.noise_scale, model.dropout, spec.noise_std if model.noise_std_m is None else model.noise_std_m,
        model.noise_per_m, model.miss_at_max, model.dark_share, model.dark_range_m,
    )  # fmt: skip
    # scale and dropout take a number each whether they are ranges or not, as they always have
    always = None if generator is None else [generator.uniform(*ends(field)) for field in fields[:2]]
    scale, dropout = always or [draw(field, None) for field in fields[:2]]
    std, per_m, misses, dark_share, dark_range = (draw(field, generator) for field in fields[2:])
    row = np.empty(_ROW)
    row[STD], row[STD_PER_M] = scale * std, scale * per_m
    row[RANGE_MIN], row[RANGE_MAX] = spec.range_min, spec.range_max
    row[DROPOUT], row[DROPPED] = dropout, math.nan if model.dropout_invalid else math.inf
    row[MISSES] = misses / spec.range_max**2
    row[DARK_SHARE], row[DARK_RANGE] = dark_share, dark_range
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
