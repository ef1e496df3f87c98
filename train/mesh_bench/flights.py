"""Explorations flown once, to be told over the radio in many ways: where the drones were, and what they scanned."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec
from imagine.mesh_comm.codec import pack_ranges, unpack_ranges
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import Level, load_level
from imagine.sim.twin import TICK_S
from imagine.train.baselines import baseline

__all__ = ["TICK_S", "Flight", "fly"]


class Flight(NamedTuple):
    """One team's exploration of a level, tick by tick of 0.1 s.

    `poses` `[ticks, drones, 3]` metres and radians, `velocities` `[ticks, drones, 2]` m/s, map frame; `ranges` float32
    `[ticks, drones, beams]` metres, to the centimetre, as they are mapped and sent.
    """

    level: Level
    poses: NDArray[np.float64]
    velocities: NDArray[np.float64]
    ranges: NDArray[np.float32]
    lidar: LidarSpec
    range_cap_m: float

    @property
    def drones(self) -> int:
        """How many drones flew."""
        return int(self.poses.shape[1])

    @property
    def seconds(self) -> float:
        """How long they flew."""
        return len(self.poses) * TICK_S


def fly(level: str, drones: int, seed: int, seconds: float) -> Flight:
    """Let a team explore a level by the coordinated baseline, from the level's launch point, for so long at most.

    It ends when all of the level is known. They fly with the default radio; what is recorded is told anew later.
    """
    settings = ExplorationSettings(
        levels=(level,), worlds=1, drones=drones, mirror=False, random_launch=False, stop_coverage=0.995,
        episode_ticks=round(seconds / TICK_S) + 1,
    )  # fmt: skip
    env, pilot = Exploration(settings, seed, restart=False), baseline("coordinated", seed)
    observation = env.reset()
    pilot.begin(env)
    cap = settings.map.range_cap_m
    poses, velocities, ranges = [], [], []
    done = False
    while not done:
        poses.append(env.twin.poses[0].copy())
        velocities.append(env.twin.velocity[0, :, :2].copy())
        ranges.append([_to_centimetres(scan, env.lidar, cap) for scan in env.ranges[0]])
        actions = np.clip(np.nan_to_num(pilot.act(env, observation)), -1.0, 1.0)
        step = env.step(actions)
        observation, done = step.observation, bool(step.done[0]) or len(poses) * TICK_S >= seconds
    return Flight(load_level(level), np.array(poses), np.array(velocities), np.array(ranges), env.lidar, cap)


def _to_centimetres(ranges: NDArray[np.float32], lidar: LidarSpec, cap_m: float) -> NDArray[np.float32]:
    return unpack_ranges(pack_ranges(ranges, lidar.range_min, cap_m), lidar.beams, cap_m)
