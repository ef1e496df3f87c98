"""With every option on, drones in the twin see bit for bit what they would see on board, and decide the same."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.action import Axes, intended_velocity, to_intent
from imagine.core.contract import ActionSpec
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.frontier import frontier_field
from imagine.core.lidar import Scan
from imagine.core.observation import observe
from imagine.core.observation_spec import ObservationSpec
from imagine.core.peer_poses import PeerPoses
from imagine.core.shield import shield_velocity
from imagine.core.visits import VisitMap
from imagine.sim.decision_state import DecisionState
from imagine.sim.exploration_kernels import fill_observations, shielded_setpoints
from imagine.sim.level import load_level
from imagine.sim.team_maps import TeamMaps
from imagine.sim.twin import TICK_S, Twin

WORLDS, DRONES, REACH_M, CAP_M = 2, 3, 2.5, 4.0
EVERYTHING: dict[str, Any] = {
    "view_cells": 16, "position": True, "heading": True, "peers": 2, "visits": "team", "visits_full_ticks": 20,
}  # fmt: skip


class Worlds:
    """Worlds in the twin with what drones keep in them; the maps stay each drone's own."""

    def __init__(self, observation: ObservationSpec, action: ActionSpec, seed: int) -> None:
        level = load_level("3")
        self.spec, self.rng = observation, np.random.default_rng(seed)
        self.twin = Twin([level] * WORLDS, DRONES, seed=seed)
        column0, row0, columns, rows = level.grid
        self.maps = TeamMaps(WORLDS, DRONES, rows, columns)
        for world in range(WORLDS):
            self.maps.clear(world, level.coverable, (column0, row0))
        self.state = DecisionState(WORLDS, DRONES, rows, columns, observation, action)
        self.alive = np.ones((WORLDS, DRONES), bool)
        self.everywhere = np.ones(WORLDS, bool)
        self.ranges = np.empty(0, np.float32)

    def links(self) -> NDArray[np.bool_]:
        positions = self.twin.poses[..., :2]
        apart = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
        linked: NDArray[np.bool_] = (apart <= REACH_M) & ~np.eye(DRONES, dtype=bool)
        return linked

    def sense(self) -> None:
        lidar = self.twin.lidar
        self.ranges = self.twin.scan()
        beams = (lidar.start, lidar.increment, lidar.range_min, CAP_M)
        self.maps.update(self.ranges, self.twin.poses, beams, np.zeros_like(self.links()), False, 20)
        self.state.sense(self.twin.poses, self.links(), self.maps.origins, self.alive, self.everywhere, self.twin.dt)

    def observe(self) -> dict[str, NDArray[np.float32]]:
        spec, lidar = self.spec, self.twin.lidar
        seen = {name: np.full((WORLDS, DRONES, *shape), np.nan, np.float32) for name, shape in spec.shapes.items()}
        fill_observations(
            0, WORLDS, seen["views"], seen["lidar"], seen["motion"], self.maps.belief, self.maps.distance,
            self.maps.origins, self.twin.poses, self.twin.velocity, self.ranges,
            (lidar.range_min, lidar.start, lidar.increment), np.array(spec.view_scales_m),
            np.array(spec.frontier_ranges_m), spec.lidar_range_m, spec.speed_mps, spec.yaw_rate_rps,
            spec.axes == "heading",
        )  # fmt: skip
        self.state.fill(seen["views"], seen["motion"], self.twin.poses, self.maps.origins)
        return seen

    def roam(self) -> None:
        """Fly a tick at random, each drone on a course of its own for a while."""
        if not hasattr(self, "courses") or self.rng.random() < 0.1:
            self.courses = self.rng.uniform(-0.8, 0.8, (WORLDS, DRONES, 3))
        self.twin.step(self.courses)


class OnBoard:
    """What one drone of a world keeps on board, on a map that grows, told of its peers by messages."""

    def __init__(self, worlds: Worlds, world: int, drone: int) -> None:
        self.worlds, self.world, self.drone = worlds, world, drone
        self.evidence, self.visits = EvidenceMap(drone, half_extent_m=3.2), VisitMap()
        self.heard: dict[int, tuple[float, float, float]] = {}

    def tick(self, now: float) -> dict[str, NDArray[np.float32]]:
        twin, at = self.worlds.twin, (self.world, self.drone)
        pose = Pose(*(float(number) for number in twin.poses[at]))
        scan = Scan(now, self.worlds.ranges[at])
        for peer in np.flatnonzero(self.worlds.links()[self.world, self.drone]):
            self.heard[int(peer)] = (*twin.poses[self.world, peer, :2], now)
        known = np.array(list(self.heard.values())).reshape(-1, 3)
        peers = PeerPoses(np.ascontiguousarray(known[:, :2]), now - known[:, 2])
        self.evidence.integrate(pose, scan, twin.lidar, CAP_M)
        self.visits.fit(self.evidence.origin_cells, self.evidence.shape)
        self.visits.count(pose.x, pose.y, peers)
        belief = self.evidence.belief()
        vx, vy, rate = twin.velocity[at]
        return observe(
            self.worlds.spec, belief, frontier_field(belief), self.evidence.origin_cells, pose, (vx, vy), rate, scan,
            twin.lidar, peers, self.visits,
        )  # fmt: skip


@pytest.mark.parametrize("axes", ["map", "heading"])
def test_every_option_shows_in_training_what_it_shows_in_flight_bit_for_bit(axes: Axes) -> None:
    worlds = Worlds(ObservationSpec(axes=axes, **EVERYTHING), ActionSpec(), seed=5)
    team = [OnBoard(worlds, world, drone) for world in range(WORLDS) for drone in range(DRONES)]
    parted = False
    for tick in range(120):
        worlds.sense()
        seen = worlds.observe()
        for own in team:
            for name, array in own.tick(TICK_S * tick).items():
                np.testing.assert_array_equal(array, seen[name][own.world, own.drone], err_msg=f"{name}, tick {tick}")
        parted |= bool((worlds.state.ages > 2.1).any(where=np.isfinite(worlds.state.ages)))
        worlds.roam()
    assert parted  # some were heard and then lost for long, some never
    assert seen["views"][:, :, 4:].max() == 1.0
    assert 0 < (seen["views"][:, :, 5] > 0).sum() < (seen["views"][:, :, 7] > 0).sum()


def test_the_dead_leave_no_visits_and_a_world_that_starts_anew_knows_none() -> None:
    worlds = Worlds(ObservationSpec(**EVERYTHING), ActionSpec(), seed=1)
    worlds.alive[0, 1] = False
    for _ in range(5):
        worlds.sense()
        worlds.roam()
    assert worlds.state.own_visits.sum(axis=(2, 3)).tolist() == [[5, 0, 5], [5, 5, 5]]
    assert worlds.state.peer_visits[1].sum() > 0
    worlds.everywhere[1] = False
    worlds.sense()
    assert worlds.state.own_visits.sum(axis=(2, 3)).tolist() == [[6, 0, 6], [5, 5, 5]]
    worlds.state.clear(1)
    assert worlds.state.own_visits[1].sum() == worlds.state.peer_visits[1].sum() == 0
    assert np.isinf(worlds.state.ages[1]).all()
    assert worlds.observe()["motion"][1, :, 7:].tolist() == [[1.0, 1.0]] * DRONES


def test_without_options_there_is_nothing_to_keep_and_nothing_to_fill() -> None:
    worlds = Worlds(ObservationSpec(view_cells=16), ActionSpec(), seed=1)
    worlds.sense()
    before = worlds.observe()
    assert worlds.state.own_visits.size == worlds.state.peer_visits.size == 0
    assert before["views"].shape[2:] == (4, 16, 16)
    assert np.isfinite(before["views"]).all()


@pytest.mark.parametrize("mode", ["plane", "body", "forward", "waypoint"])
@pytest.mark.parametrize("axes", ["map", "heading"])
def test_decisions_become_the_setpoints_that_fly_and_stand(mode: Any, axes: Axes) -> None:
    action = ActionSpec(mode=mode)
    worlds = Worlds(ObservationSpec(view_cells=16, axes=axes), action, seed=2)
    lidar, limits = worlds.twin.lidar, worlds.twin.limits
    intents: dict[tuple[int, ...], Any] = {}
    shielded = 0
    for tick in range(48):
        ranges, poses = worlds.twin.scan(), worlds.twin.poses
        at = {index: Pose(*(float(number) for number in poses[index])) for index in np.ndindex(WORLDS, DRONES)}
        if tick % 6 == 0:  # each decision stands for six ticks
            actions = worlds.rng.uniform(-1.4, 1.4, (WORLDS, DRONES, action.size)).astype(np.float32)
            worlds.state.decide(actions, poses)
            intents = {index: to_intent(actions[index], action, axes, pose) for index, pose in at.items()}
        setpoints = np.zeros((WORLDS, DRONES, 3))
        shielded_setpoints(
            setpoints, worlds.state.intents, worlds.state.parameters, poses, ranges,
            (lidar.range_min, lidar.start, lidar.increment), (limits.radius_m, limits.lag_s, limits.acceleration_mps2),
        )  # fmt: skip
        for index, pose in at.items():
            vx, vy, rate = intended_velocity(intents[index], action, axes, pose)
            safe = shield_velocity(vx, vy, Scan(0.0, ranges[index]), lidar, limits)
            assert setpoints[index] == pytest.approx((*safe, rate), abs=1e-9)
            shielded += safe != (vx, vy)
        worlds.twin.step(setpoints)
    assert shielded > 5
    assert worlds.twin.contacts.sum() == 0
    assert np.hypot(*worlds.twin.velocity[..., :2].reshape(-1, 2).T).max() > 0.05
    assert all(math.isfinite(number) for number in worlds.twin.poses.reshape(-1))
