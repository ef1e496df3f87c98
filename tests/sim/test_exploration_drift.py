"""Where drift is on, drones of batched exploration go by estimates that are off as flights' are; the world does not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.raster import CELL
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.odometry_drift import DriftSettings

FAR_OFF = DriftSettings(enabled=True, sigma_m=0.4, length_m=4.0)
SMALL = ExplorationSettings(levels=("1",), drones=2, mirror=False, random_launch=False, episode_ticks=40)


def made(drift: DriftSettings, worlds: int = 1, keys: list[int] | None = None, **changes: object) -> Exploration:
    settings = SMALL.model_copy(update={"worlds": worlds, "drift": drift, **changes})
    return Exploration(settings, seed=5, world_keys=keys)


def flown(env: Exploration, ticks: int) -> list[tuple[NDArray[np.float64], ...]]:
    """Fly by the planner; return true and estimated poses, views and layers of world 0 (or of the last) by tick."""
    env.reset()
    seen = []
    for _ in range(ticks):
        step = env.step(np.nan_to_num(env.planner_actions()))
        last = (env.twin.poses, env.estimates, step.observation.policy["views"], env.maps.layers)
        seen.append(tuple(array[-1].copy() for array in last))
    return seen


def test_estimates_are_the_truth_unless_drift_is_on_and_at_the_launch() -> None:
    env = made(DriftSettings())
    flown(env, 10)
    np.testing.assert_array_equal(env.estimates, env.twin.poses)
    env = made(FAR_OFF, worlds=4)
    env.reset()
    np.testing.assert_array_equal(env.estimates, env.twin.poses)
    for _ in range(39):  # and once more after this episode
        env.step(np.nan_to_num(env.planner_actions()))
    off = np.hypot(*(env.estimates - env.twin.poses)[..., :2].reshape(-1, 2).T)
    assert 0.05 < off.mean() < 1.0
    assert (off > 0.0).all()
    done = env.step(np.nan_to_num(env.planner_actions())).done
    assert done.any()
    np.testing.assert_array_equal(env.estimates[done], env.twin.poses[done])


def test_a_world_alone_drifts_as_in_a_batch_over_several_episodes() -> None:
    """The others end their episodes at other times, which must not move this one's drift."""
    together = flown(made(FAR_OFF, worlds=3, stagger=True), 100)
    alone = flown(made(FAR_OFF, worlds=1, keys=[2], stagger=True), 100)
    for one, other in zip(together, alone, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)


def western_wall_m(env: Exploration) -> float:
    """Where a drone's own map has the western wall of level 0, which stands at 0 m."""
    layer = env.maps.layers[0, 0, 0]
    _, columns = np.nonzero(layer > 0)
    x = (columns + env.maps.origins[0, 0] + 0.5) * CELL
    return float(np.median(x[x < 0.8]))


def test_maps_are_drawn_where_a_drone_takes_itself_to_be() -> None:
    env = made(FAR_OFF, drones=1, levels=("0",), episode_ticks=500)
    env.reset()
    assert western_wall_m(env) == pytest.approx(0.0, abs=0.051)
    env.maps.layers[:] = 0
    assert env._drift is not None
    env._drift.error[0, 0, 0] = 0.5
    hold = np.zeros((1, 1, 2), np.float32)
    for _ in range(5):
        env.step(hold)
    assert env.estimates[0, 0, 0] - env.twin.poses[0, 0, 0] == pytest.approx(0.5, abs=0.05)
    assert western_wall_m(env) == pytest.approx(0.5, abs=0.11)


def test_levels_are_explored_all_the_same_with_the_drift_of_flights() -> None:
    env = made(DriftSettings(enabled=True), worlds=4, drones=3, episode_ticks=300)
    env.reset()
    for _ in range(200):
        episodes = env.step(np.nan_to_num(env.planner_actions())).episodes
        if episodes:
            break
    assert episodes[0].coverage > 0.99
