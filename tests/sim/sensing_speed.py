"""What a scan costs: CPU microseconds a drone on one core, by level, beams and reach; a script for docs/sensing.md.

`python tests/sim/sensing_speed.py`
"""

from __future__ import annotations

import time

import numpy as np

from imagine.core.lidar import LidarSpec
from imagine.sim.level import load_level
from imagine.sim.lidar_model import LidarModel
from imagine.sim.sensing import Sensing
from imagine.sim.workers import Workers

WORLDS, DRONES, SCANS, ROUNDS = 32, 3, 20, 10


def microseconds(name: str, beams: int, reach_m: float | None, model: LidarModel) -> float:
    """Return the least CPU time of several rounds, per drone and scan, from random launch poses."""
    level, rng = load_level(name), np.random.default_rng(0)
    sensing = Sensing(WORLDS, DRONES, LidarSpec(beams=beams), 0, Workers(1), model=model)
    for world in range(WORLDS):
        sensing.set_level(world, level)
    poses = np.array([level.launch_poses(DRONES, rng) for _ in range(WORLDS)])
    velocity = np.full_like(poses, 0.5)
    sensing.scan(poses, velocity, 0.08, 0, reach_m=reach_m)
    best = np.inf
    for _ in range(ROUNDS):
        began = time.thread_time()
        for tick in range(SCANS):
            sensing.scan(poses, velocity, 0.08, tick, reach_m=reach_m)
        best = min(best, (time.thread_time() - began) / (SCANS * WORLDS * DRONES))
    return best * 1e6


def main() -> None:
    """Print the table."""
    faulty = LidarModel(dropout=(0.02, 0.02), miss_at_max=0.2, dark_share=0.1)
    for what, model in (("", LidarModel()), ("all faults", faulty), ("skew", LidarModel(skew=True))):
        for name in ("4", "6"):
            for beams in (64, 360):
                near, far = (microseconds(name, beams, reach, model) for reach in (4.0, None))
                print(f"level {name}, {beams:3d} beams {what:10s}: {near:5.1f} us to 4 m, {far:5.1f} us to 12 m")


if __name__ == "__main__":
    main()
