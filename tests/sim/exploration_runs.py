"""Runs of a batch with everything on, to be repeated: `python tests/sim/exploration_runs.py LEVEL_FILE CORES`.

As a script it keeps to so many cores and prints how many threads it used and the hash of all that came of a run.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.contract import ActionSpec
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.dynamics import DynamicsSettings
from imagine.sim.exploration import Exploration, Step
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.lidar_model import LidarModel
from imagine.sim.odometry_drift import DriftSettings
from imagine.sim.radio import RadioSettings
from imagine.sim.reward import RewardSettings

BUSY_HALL = """
title: a hall with a wall, a post, two people on their ways and crates that can be pushed
size_m: [11, 8]
launch: [1.2, 1.2]
walls:
  - [[4, 0], [4, 5]]
circles:
  - {center: [7.5, 2.2], radius: 0.35}
people:
  - {loop: [[1, 6.8], [10, 6.8], [10, 6.2], [1, 6.2]], radius: 0.25}
  - {loop: [[5.2, 1], [5.2, 5]], radius: 0.3}
crates:
  - {center: [2.4, 3.4], size: [0.6, 0.5], yaw_deg: 20}
  - {center: [8.2, 4.6], size: [0.5, 0.5]}
"""
WORLDS, DRONES, SEED = 5, 3, 21


def everything(hall: str, **changes: Any) -> ExplorationSettings:
    """Return settings with mixed levels, people, crates, faults and losses, and all that a policy may see."""
    settings: dict[str, Any] = {
        "levels": ("1", "3", hall, "4"), "worlds": WORLDS, "drones": DRONES, "episode_ticks": 130,
        "stop_coverage": 0.9, "protocol": "multi-hop", "action": ActionSpec(mode="body"),
        "observation": ObservationSpec(
            view_cells=16, position=True, heading=True, peers=2, visits="team", axes="heading", visits_full_ticks=20
        ),
        "radio": RadioSettings(model="path-loss", tx_dbm=(-4.0, 2.0), loss=(0.1, 0.2), latency_s=0.07),
        "reward": RewardSettings(
            collision_penalty=0.5, kill_on_collision=True, step_cost=0.001, completion_bonus=1.0, normalise="sweep"
        ),
        "dynamics": DynamicsSettings(
            lag_s=(0.05, 0.4), drag_per_s=(0.0, 0.6), mass_kg=(0.05, 0.5), delay_s=(0.0, 0.3), wind_mps=(0.0, 0.3)
        ),
        "budget_bytes_per_s": (4000.0, 31250.0),
        "drift": DriftSettings(enabled=True, share=0.8),
        "sensing": LidarModel(
            noise_per_m=0.002, noise_scale=(0.5, 2.0), dropout=(0.0, 0.1), miss_at_max=(0.1, 0.3),
            dark_share=(0.0, 0.1), skew=True,
        ),
    }  # fmt: skip
    return ExplorationSettings(**(settings | changes))


def act(env: Exploration, keys: Sequence[int], step: int) -> NDArray[np.float32]:
    """Return the planner's actions, disturbed by what depends on the world's key and the step alone."""
    actions = np.nan_to_num(env.planner_actions())
    for world, key in enumerate(keys):
        rng = np.random.default_rng([key, step // 8])  # the same for a while, or it would average out
        actions[world] += rng.normal(0.0, 0.6, actions[world].shape).astype(np.float32)
    return actions


def fly(env: Exploration, keys: Sequence[int], steps: int) -> Iterator[Step]:
    """Start and fly so many decisions."""
    env.reset()
    for step in range(steps):
        yield env.step(act(env, keys, step))


def state(env: Exploration, step: Step, world: int) -> dict[str, Any]:
    """Return all that a decision brought in a world, what is compared and hashed."""
    twin, maps, air = env.twin, env.maps, env.air
    told = {f"see {name}": array[world].copy() for name, array in step.observation.policy.items()}
    discs, edges = twin.mover_discs[world], twin.mover_edges[world]
    return told | {
        "critic": step.observation.critic[world], "reward": step.reward[world].copy(), "done": step.done[world],
        "ranges": env.ranges[world].copy(), "poses": twin.poses[world].copy(), "velocity": twin.velocity[world].copy(),
        "estimates": env.estimates[world].copy(),
        "wind": twin.wind[world].copy(), "alive": env.alive[world].copy(), "contacts": twin.contacts[world].copy(),
        "people": discs[discs[:, 2] > 0.0].copy(), "crates": edges[edges.any(axis=1)].copy(),
        "bytes": air.bytes_sent[world].copy(), "heard": air.state.links[world].copy(),
        "versions": maps.versions[world].copy(), "belief": maps.belief[world].copy(),
        "cost": maps.arrays.cost[world].copy(), "level": twin.levels[world].name,
        "episodes": [
            {name: value for name, value in asdict(episode).items() if name != "world"}
            for episode in step.episodes if episode.world == world
        ],
    }  # fmt: skip


def run_hash(hall: str, steps: int) -> tuple[str, int]:
    """Return the hash of all that came of a run, and how many threads flew it."""
    env = Exploration(everything(hall), SEED)
    digest = hashlib.sha256()
    for step in fly(env, range(WORLDS), steps):
        for world in range(WORLDS):
            for name, value in state(env, step, world).items():
                digest.update(name.encode())
                digest.update(value.tobytes() if isinstance(value, np.ndarray | np.generic) else _text(value))
    return digest.hexdigest(), env.twin.workers.threads


def _text(value: Any) -> bytes:
    return json.dumps(value, default=lambda array: np.asarray(array).tolist()).encode()


if __name__ == "__main__":
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[2])])
    print(*run_hash(sys.argv[1], int(sys.argv[3])))
