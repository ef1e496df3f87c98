"""Drones begin an episode in the air, having heard each other on the ground: nobody maps a teammate as a wall."""

import numpy as np
import pytest

from imagine.core.raster import CELL
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.radio import RadioSettings


def cells_at_teammates(env: Exploration) -> int:
    """How many cells within 0.2 m of another drone a drone takes for occupied, after the launch's scans."""
    count = 0
    rows, columns = env.maps.belief.shape[2:]
    x = (np.arange(columns) + env.maps.origins[0, 0] + 0.5) * CELL
    y = (np.arange(rows) + env.maps.origins[0, 1] + 0.5) * CELL
    for drone in range(env.drones):
        for other in set(range(env.drones)) - {drone}:
            at_x, at_y, _ = env.twin.poses[0, other]
            near = (x[None, :] - at_x) ** 2 + (y[:, None] - at_y) ** 2 < 0.2**2
            count += int((env.maps.layers[0, drone, drone][near] > 0).sum())
    return count


@pytest.mark.parametrize(("range_m", "mapped"), [(5.0, False), (0.2, True)])
def test_teammates_in_reach_at_the_launch_are_not_mapped(range_m: float, mapped: bool) -> None:
    settings = ExplorationSettings(
        levels=("0",), worlds=1, mirror=False, random_launch=False, radio=RadioSettings(range_m=range_m)
    )
    env = Exploration(settings, seed=0)
    env.reset()
    assert (cells_at_teammates(env) > 0) is mapped
