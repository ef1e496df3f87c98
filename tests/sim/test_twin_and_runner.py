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
from imagine.sim.air import DIGEST, SCAN, STATUS, TILES
from imagine.sim.exploration import Exploration, Observation
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.odometry_drift import DriftSettings
from imagine.sim.radio import RadioSettings

TICKS = 160
FALLS_AT = 110


EVERYTHING: dict[str, Any] = {
    "position": True, "heading": True, "peers": 2, "peer_places": 2, "frontiers": 4, "visits": "team",
    "visits_full_ticks": 20,
}  # fmt: skip


def check(own: OnBoard, env: Exploration, seen: Observation, planned: Any, when: str) -> None:
    """Compare all that a drone knows, sees and plans with what it would on board."""
    at, maps, evidence = own.at, env.maps, own.evidence
    about = f"world and drone {at}, {when}"
    for source in range(env.drones):
        layer = evidence.layer(source + 1)
        cells, versions = maps.layers[*at, source], maps.versions[*at, source]
        assert_array_equal(cells, own.window(layer.cells, 1), f"cells of {source}, {about}")
        assert_array_equal(versions, own.window(layer.versions, TILE), f"versions of {source}, {about}")
        assert np.count_nonzero(layer.cells) == np.count_nonzero(cells)  # none off the grid
    assert_array_equal(maps.belief[at], own.window(evidence.belief(), 1), about)
    field, inner = own.field(), np.s_[PAD:-PAD, PAD:-PAD]
    assert_array_equal(maps.arrays.cost[at][inner], own.window(field.cost[inner], 2), about)
    assert_array_equal(maps.arrays.states[at][inner], own.window(field.states, 2), about)
    for name, array in own.observation(field).items():
        assert_array_equal(seen.policy[name][at], array, f"{name}, {about}")
    wanted = own.planned(field)
    if wanted is None or not env.alive[at]:
        assert np.isnan(planned[at]).all(), about
    else:
        action = action_toward_kernel(*wanted, env.decisions.parameters, own.pose.yaw, 0.0)
        assert_array_equal(planned[at], np.float32(action), about)


@pytest.mark.parametrize(
    ("level", "protocol", "axes", "options", "radio", "drifts"),
    [
        ("4", "off", "map", EVERYTHING, {}, True),
        ("5", "one-hop", "heading", EVERYTHING, {}, False),
        ("4", "one-hop", "map", EVERYTHING, {"loss": 0.2, "latency_s": 0.15}, False),
        ("5", "multi-hop", "map", EVERYTHING, {"range_m": 3.0}, True),
        ("4", "multi-hop", "heading", {}, {"loss": 0.1, "model": "path-loss"}, False),
    ],
)
def test_a_batched_drone_knows_what_a_runner_would_know(
    level: str, protocol: Any, axes: Any, options: dict[str, Any], radio: dict[str, Any], drifts: bool
) -> None:
    settings = ExplorationSettings(
        levels=(level,), worlds=2, drones=3, mirror=True, random_launch=level == "4", stop_coverage=1.0,
        observation=ObservationSpec(view_cells=16, axes=axes, **options), action=ActionSpec(mode="body"),
        protocol=protocol, radio=RadioSettings(**radio), drift=DriftSettings(enabled=drifts),
    )  # fmt: skip
    env = Exploration(settings, seed=11, restart=False)
    seen = env.reset()
    teams = [TeamOnBoard(env, world) for world in range(2)]
    for tick in range(TICKS):
        planned = env.planner_actions()
        for team in teams:
            team.tick()
            assert_array_equal(team.delivered, env.air.state.links[team.world]["delivered"])
            for own in team.drones:
                assert not own.node.stats
                check(own, env, seen, planned, f"tick {tick}")
        if tick == FALLS_AT:
            env.alive[:, 2] = False
        actions = np.nan_to_num(planned)
        actions[..., 2] = 0.5 * np.sin(tick / 7.0 + np.arange(3))  # they turn as they go
        seen = env.step(actions).observation
    assert (env.estimates != env.twin.poses).any() == drifts
    assert (sum(team.relayed for team in teams) > 0) == (protocol == "multi-hop")
    for team in teams:
        assert (team.lost > 0) == ("loss" in radio)
        assert team.said[STATUS] > 0
        assert (team.said[[SCAN, TILES, DIGEST]] > 0).tolist() == [protocol != "off"] * 3
        told = env.maps.versions[team.world] > 0
        assert told.any(axis=(2, 3)).sum() >= (3 if protocol == "off" else 7)
