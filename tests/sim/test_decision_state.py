"""What drones of a batch keep beyond their maps: whom they were told of, where they have been, what they decided.

That all of it is bit for bit what a drone has on board is the subject of `test_twin_and_runner.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from imagine.core.action import Axes, intended_velocity, to_intent
from imagine.core.contract import ActionSpec
from imagine.core.frames import Pose
from imagine.core.lidar import Scan
from imagine.core.observation_spec import ObservationSpec
from imagine.core.shield import shield_velocity
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.radio import RadioSettings

WORLDS, DRONES = 2, 3
EVERYTHING: dict[str, Any] = {
    "view_cells": 16, "position": True, "heading": True, "peers": 2, "visits": "team", "visits_full_ticks": 20,
}  # fmt: skip


def make(observation: dict[str, Any], seed: int = 5, **changes: Any) -> Exploration:
    settings = ExplorationSettings(
        levels=("3",), worlds=WORLDS, drones=DRONES, mirror=False, observation=ObservationSpec(**observation),
        stop_coverage=1.0, **changes,
    )  # fmt: skip
    env = Exploration(settings, seed)
    env.reset()
    return env


def roam(env: Exploration, ticks: int, rng: np.random.Generator) -> None:
    """Fly at random, each drone on a course of its own for a while."""
    actions = np.zeros((WORLDS, DRONES, env.settings.action.size), np.float32)
    for tick in range(ticks):
        if tick % 10 == 0:
            actions = rng.uniform(-1.0, 1.0, actions.shape).astype(np.float32)
        env.step(actions)


def test_peers_are_known_by_what_they_said_and_how_long_ago() -> None:
    env = make(EVERYTHING, radio=RadioSettings(range_m=2.0))
    ages = np.where(env.links(), 0.0, np.inf)  # they met at the launch
    np.testing.assert_array_equal(env.decisions.ages, ages)
    flown = [env.twin.poses[..., :2].copy()]
    rng = np.random.default_rng(1)
    met = parted = 0
    for tick in range(150):
        before = env.air.state.links["delivered"].copy()
        if tick % 30 == 0:
            actions = np.sign(rng.uniform(-1.0, 1.0, (WORLDS, DRONES, 2))).astype(np.float32)
        env.step(actions)
        heard = np.swapaxes(env.air.state.links["delivered"] > before, 1, 2)  # [world, receiver, sender]
        ages = np.where(heard, 0.0, ages + 0.1)
        np.testing.assert_allclose(env.decisions.ages, ages, atol=1e-9)
        for world, receiver, sender in np.argwhere(heard):  # where it was lately, if not just now
            reported = env.decisions.positions[world, receiver, sender]
            assert any((poses[world, sender] == reported).all() for poses in flown[-8:])
        met += heard.sum()
        parted += (ages[np.isfinite(ages)] > 2.1).sum()
        flown.append(env.twin.poses[..., :2].copy())
    assert met > 200
    assert parted > 50
    known = np.isfinite(env.decisions.ages)
    assert not known[:, range(DRONES), range(DRONES)].any()
    env.reset()
    np.testing.assert_array_equal(env.decisions.ages, np.where(env.links(), 0.0, np.inf))


def test_under_the_protocol_off_nobody_is_known() -> None:
    env = make(EVERYTHING, protocol="off", radio=RadioSettings(range_m=50.0))
    roam(env, 20, np.random.default_rng(0))
    assert (env.air.state.links["delivered"].sum(axis=(1, 2)) > 0).all()  # though they hear of each other
    assert np.isinf(env.decisions.ages).all()
    assert env.decisions.own_visits.sum(axis=(2, 3)).tolist() == [[21] * DRONES] * WORLDS
    assert not env.decisions.peer_visits.any()


def test_the_dead_leave_no_visits_and_a_world_that_starts_anew_knows_none() -> None:
    env = make(EVERYTHING, seed=1, radio=RadioSettings(range_m=50.0))
    env.alive[0, 1] = False
    roam(env, 5, np.random.default_rng(0))
    state = env.decisions
    assert state.own_visits.sum(axis=(2, 3)).tolist() == [[6, 1, 6], [6, 6, 6]]  # with that of the launch
    assert state.peer_visits[1].sum() > 0
    active = np.array([True, False])
    state.sense(env.estimates, env.air, env.ticks, env.maps.origins, env.alive, active)
    assert state.own_visits.sum(axis=(2, 3)).tolist() == [[7, 1, 7], [6, 6, 6]]
    state.clear(1)
    assert state.own_visits[1].sum() == state.peer_visits[1].sum() == 0
    assert np.isinf(state.ages[1]).all()
    assert state.own_visits[0].sum() == 15
    views, motion = (
        np.zeros((WORLDS, DRONES, *env.settings.observation.shapes[name]), np.float32) for name in ("views", "motion")
    )
    state.fill(views, motion, env.estimates, env.maps.origins)
    assert motion[1, :, 7:].tolist() == [[1.0, 1.0]] * DRONES
    assert not views[1, :, 4:].any()
    assert views[0, [0, 2], 4:].any()


def test_without_options_there_is_nothing_to_keep_and_nothing_to_fill() -> None:
    env = make({"view_cells": 16}, seed=1)
    assert env.decisions.own_visits.size == env.decisions.peer_visits.size == 0
    seen = env.step(np.zeros((WORLDS, DRONES, 2), np.float32)).observation.policy
    assert seen["views"].shape[2:] == (4, 16, 16)
    assert seen["motion"].shape[2:] == (3,)
    assert np.isfinite(seen["views"]).all()


@pytest.mark.parametrize("mode", ["plane", "body", "forward", "waypoint"])
@pytest.mark.parametrize("axes", ["map", "heading"])
def test_decisions_become_the_setpoints_that_fly_and_stand(mode: Any, axes: Axes) -> None:
    action = ActionSpec(mode=mode, decision_ticks=6)
    env = make({"view_cells": 16, "axes": axes}, seed=2, action=action)
    rng = np.random.default_rng(2)
    limits, running = env.settings.limits, np.ones(WORLDS, bool)
    intents: dict[tuple[int, ...], Any] = {}
    shielded = 0
    for tick in range(48):
        ranges = env.ranges.copy()
        at = {index: Pose(*(float(number) for number in env.twin.poses[index])) for index in np.ndindex(WORLDS, DRONES)}
        if tick % 6 == 0:  # each decision stands for six ticks
            actions = rng.uniform(-1.4, 1.4, (WORLDS, DRONES, action.size)).astype(np.float32)
            env.decisions.decide(actions, env.estimates)
            intents = {index: to_intent(actions[index], action, axes, pose) for index, pose in at.items()}
        env._tick(running, np.zeros_like(running), observes=True)
        for index, pose in at.items():
            vx, vy, rate = intended_velocity(intents[index], action, axes, pose)
            safe = shield_velocity(vx, vy, Scan(0.0, ranges[index]), env.lidar, limits)
            assert env._setpoints[index] == pytest.approx((*safe, rate), abs=1e-9)
            shielded += safe != (vx, vy)
    assert shielded > 5
    assert env.twin.wall_contacts.sum() == 0  # drones that fly at each other may meet
    assert np.hypot(*env.twin.velocity[..., :2].reshape(-1, 2).T).max() > 0.05
    assert all(math.isfinite(number) for number in env.twin.poses.reshape(-1))
