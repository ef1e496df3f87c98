"""The first promise of the twin: from the same poses, scans and messages a batched drone knows, bit for bit, what a
runner's drone knows, sees what its policy would be shown, and would be sent where its planner would go."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from team_on_board import OnBoard, TeamOnBoard

from imagine.core.action import action_toward_kernel
from imagine.core.contract import ActionSpec
from imagine.core.frontier import PAD
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import TILE
from imagine.sim.exploration import Exploration, Observation
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.radio import RadioSettings

TICKS = 160
FALLS_AT = 110


def check(own: OnBoard, env: Exploration, seen: Observation, planned: Any, when: str) -> None:
    """Compare all that a drone knows, sees and plans with what it would on board."""
    drone, maps, evidence = own.drone, env.maps, own.evidence
    for source in range(env.drones):
        layer = evidence.layer(source + 1)
        about = f"drone {drone} of {source}, {when}"
        assert_array_equal(maps.layers[0, drone, source], own.window(layer.cells, 1), err_msg=f"cells {about}")
        assert_array_equal(maps.versions[0, drone, source], own.window(layer.versions, TILE), f"versions {about}")
        assert np.count_nonzero(layer.cells) == np.count_nonzero(maps.layers[0, drone, source])  # none off the grid
    about = f"drone {drone}, {when}"
    assert_array_equal(maps.belief[0, drone], own.window(evidence.belief(), 1), err_msg=about)
    field, inner = own.field(), np.s_[PAD:-PAD, PAD:-PAD]
    assert_array_equal(maps.arrays.cost[0, drone][inner], own.window(field.cost[inner], 2), err_msg=about)
    assert_array_equal(maps.arrays.states[0, drone][inner], own.window(field.states, 2), err_msg=about)
    for name, array in own.observation(field).items():
        assert_array_equal(seen.policy[name][0, drone], array, err_msg=f"{name} of {about}")
    wanted = own.planned(field)
    if wanted is None or not env.alive[0, drone]:
        assert np.isnan(planned[0, drone]).all(), about
    else:
        action = action_toward_kernel(*wanted, env.decisions.parameters, own.pose.yaw, 0.0)
        assert_array_equal(planned[0, drone], np.float32(action), err_msg=about)


@pytest.mark.parametrize(
    ("level", "protocol", "axes", "radio"),
    [
        ("4", "off", "map", {}),
        ("5", "one-hop", "heading", {}),
        ("4", "one-hop", "map", {"loss": 0.2, "latency_s": 0.15}),
        ("5", "multi-hop", "map", {"range_m": 3.0}),
        ("4", "multi-hop", "heading", {"loss": 0.1, "model": "path-loss"}),
    ],
)
def test_a_batched_drone_knows_what_a_runner_would_know(level: str, protocol: Any, axes: Any, radio: Any) -> None:
    settings = ExplorationSettings(
        levels=(level,), worlds=1, drones=3, mirror=False, random_launch=level == "4", stop_coverage=1.0,
        observation=ObservationSpec(view_cells=16, axes=axes), action=ActionSpec(mode="body"),
        protocol=protocol, radio=RadioSettings(**radio),
    )  # fmt: skip
    env = Exploration(settings, seed=11, restart=False)
    seen = env.reset()
    team = TeamOnBoard(env)
    for tick in range(TICKS):
        team.tick()
        assert_array_equal(team.delivered, env.air.state.links[0]["delivered"])
        planned = env.planner_actions()
        for own in team.drones:
            assert not own.node.stats
            check(own, env, seen, planned, f"tick {tick}")
        if tick == FALLS_AT:
            env.alive[0, 2] = False
        actions = np.nan_to_num(planned)
        actions[0, :, 2] = 0.5 * np.sin(tick / 7.0 + np.arange(3))  # they turn as they go
        seen = env.step(actions).observation
    assert team.said[3] > 3 * TICKS / 10
    assert (team.lost > 0) == ("loss" in radio)
    if protocol != "off":
        assert (team.said > 0).all()  # scans, tiles, digests
        told = env.maps.versions[0] > 0
        assert all(told[drone, source].any() for drone in range(3) for source in range(3))
