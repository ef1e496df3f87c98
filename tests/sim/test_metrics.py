"""The recorder of a batch tells of each world what a plain account of that world alone would tell."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.sim import metrics
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.metrics import SAMPLE_TICKS, EpisodeMetrics, EpisodeTotals, Recorder, first_at_least
from imagine.sim.radio import RadioSettings

COVERABLE = 1000


class PlainAccount:
    """One world's episode, kept in lists and counted only at its end."""

    def __init__(self, poses: NDArray[np.float64]) -> None:
        self.poses, self.coverage, self.linked, self.discovered, self.alive = [poses.copy()], [], [], [], []

    def add(self, coverage: float, poses: Any, linked: Any, discovered: Any, alive: Any) -> None:
        self.coverage.append(coverage)
        for kept, new in (
            (self.poses, poses), (self.linked, linked), (self.discovered, discovered), (self.alive, alive),
        ):  # fmt: skip
            kept.append(new.copy())

    def check(self, told: EpisodeMetrics) -> None:
        ticks, drones = len(self.coverage), len(self.poses[0])
        assert told.ticks == ticks
        np.testing.assert_array_equal(told.curve, np.array(self.coverage, np.float32))
        for share, time in ((0.9, told.t90), (0.95, told.t95), (0.99, told.t99)):
            assert time == next((t + 1 for t, c in enumerate(told.curve) if c >= np.float32(share)), None)
        for drone in range(drones):
            steps = [math.dist(a[drone, :2], b[drone, :2]) for a, b in zip(self.poses, self.poses[1:], strict=False)]
            assert told.path_m[drone] == pytest.approx(sum(steps), abs=1e-9)
            assert told.alive_ticks[drone] == sum(bool(alive[drone]) for alive in self.alive)
            heard = [
                {o for o in range(drones) if o != drone and linked[drone, o] and alive[drone] and alive[o]}
                for linked, alive in zip(self.linked, self.alive, strict=True)
            ]
            assert told.link_ticks[drone] == sum(bool(others) for others in heard)
            assert told.pair_ticks[drone].tolist() == [sum(o in others for others in heard) for o in range(drones)]
            samples = [*self.discovered[SAMPLE_TICKS - 1 :: SAMPLE_TICKS]]
            if ticks % SAMPLE_TICKS:
                samples.append(self.discovered[-1])
            shares = [found[drone] / COVERABLE for found in samples]
            np.testing.assert_allclose(told.drone_curves[drone], shares, rtol=1e-6)


def totals(discovered: Any, **changes: Any) -> EpisodeTotals:
    drones = len(discovered)
    zeros = np.zeros(drones, np.int64)
    given: dict[str, Any] = {
        "level": "x", "coverable": COVERABLE, "seen": 1, "discovered": np.asarray(discovered, np.int64), "known": zeros,
        "contacts": np.zeros((drones, 3), np.int64), "bytes_by": np.zeros((drones, 4), np.int64),
        "cells_by": np.zeros((drones, 3), np.int64),
    }  # fmt: skip
    return EpisodeTotals(**(given | changes))


@given(st.integers(0, 2**32), st.integers(1, 4), st.integers(1, 4), st.integers(1, 60))
@settings(max_examples=40, deadline=None)
def test_a_batch_is_recorded_as_each_world_alone(seed: int, worlds: int, drones: int, ticks: int) -> None:
    rng = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "_FIRST_CAPACITY", 8)  # so that the curves have to grow
        recorder = Recorder(worlds, drones, seed=3)
    poses = rng.normal(size=(worlds, drones, 3))
    for world in range(worlds):
        recorder.begin(world, poses[world])
    accounts = [PlainAccount(p) for p in poses]
    discovered = np.zeros((worlds, drones), np.int64)
    for tick in range(ticks):
        poses += rng.normal(size=poses.shape)
        discovered += rng.integers(0, 9, discovered.shape)
        coverage = np.minimum(discovered.sum(axis=1) / 100.0, 1.0)
        linked, alive = rng.random((worlds, drones, drones)) < 0.4, rng.random((worlds, drones)) < 0.8
        recorder.record(coverage, poses, linked, discovered, alive)
        for world, account in enumerate(accounts):
            account.add(coverage[world], poses[world], linked[world], discovered[world], alive[world])
            if rng.random() < 0.1 or tick == ticks - 1:
                told = recorder.finish(world, totals(discovered[world]))
                assert (told.world, told.seed) == (world, 3)
                account.check(told)
                poses[world], discovered[world] = rng.normal(size=(drones, 3)), 0  # the next episode, elsewhere
                recorder.begin(world, poses[world])
                accounts[world] = PlainAccount(poses[world])


def test_what_was_told_stays_when_the_next_episode_is_recorded() -> None:
    recorder = Recorder(1, 2)
    poses, discovered = np.zeros((1, 2, 3)), np.array([[3, 4]])
    linked = np.ones((1, 2, 2), bool)
    recorder.begin(0, poses[0])
    recorder.record(np.array([0.25]), poses + 1.0, linked, discovered)
    told = recorder.finish(0, totals(discovered[0]))
    recorder.begin(0, poses[0])
    for _ in range(3):
        recorder.record(np.array([0.75]), poses, linked, discovered)
    discovered[:] = 0
    assert told.curve.tolist() == [0.25]
    assert told.discovered.tolist() == [3, 4]
    assert told.path_m.tolist() == pytest.approx([math.sqrt(2.0)] * 2)
    assert told.link_ticks.tolist() == [1, 1]


def test_everyone_flies_where_nobody_says_otherwise() -> None:
    recorder = Recorder(1, 3)
    for _ in range(4):
        recorder.record(np.zeros(1), np.zeros((1, 3, 3)), np.zeros((1, 3, 3), bool), np.zeros((1, 3), np.int64))
    assert recorder.finish(0, totals([0, 0, 0])).alive_ticks.tolist() == [4, 4, 4]


@pytest.mark.parametrize(
    ("discovered", "ratio"), [([30, 10, 20], 3.0), ([30, 0], 30.0), ([0, 0], 1.0), ([7], 1.0), ([5, 5], 1.0)]
)
def test_the_ratio_of_the_most_to_the_least_productive_is_finite(discovered: list[int], ratio: float) -> None:
    assert one_tick(totals(discovered)).productivity_ratio == ratio


def one_tick(end: EpisodeTotals) -> EpisodeMetrics:
    drones = len(end.discovered)
    recorder = Recorder(1, drones)
    recorder.record(np.zeros(1), np.zeros((1, drones, 3)), np.zeros((1, drones, drones), bool), end.discovered[None])
    return recorder.finish(0, end)


def test_counters_are_told_as_they_stood() -> None:
    contacts, sent, cells = np.arange(6).reshape(2, 3), np.arange(8).reshape(2, 4), np.arange(6).reshape(2, 3) + 9
    told = one_tick(totals([1, 2], contacts=contacts, bytes_by=sent, cells_by=cells))
    assert (told.contacts, told.total_bytes) == (15, 28)
    for kept, counter in ((told.contacts_by, contacts), (told.bytes_by, sent), (told.cells_by, cells)):
        np.testing.assert_array_equal(kept, counter)
        counter += 1  # the next episode counts on
        assert not (kept == counter).any()


def test_a_coverage_of_just_the_share_counts() -> None:
    assert first_at_least(np.array([0.5, 0.9, 0.95], np.float32), 0.9) == 2
    assert first_at_least(np.array([0.5, 0.8999], np.float32), 0.9) is None


def test_exploration_tells_what_can_be_seen_from_outside() -> None:
    explored = ExplorationSettings(
        levels=("1",),
        worlds=2,
        drones=2,
        mirror=False,
        episode_ticks=45,
        stop_coverage=1.0,
        radio=RadioSettings(range_m=1.5),
    )
    env = Exploration(explored, seed=5, restart=False)
    env.reset()
    accounts = [PlainAccount(poses) for poses in env.twin.poses]
    everyone = np.ones(2, bool)
    for _ in range(45):
        actions = np.nan_to_num(env.planner_actions())
        actions[:, 1] = 0.0  # one stays, so that they lose each other
        step = env.step(actions)
        linked, coverage = env.links(), env.maps.coverage()
        for world, account in enumerate(accounts):
            account.add(coverage[world], env.twin.poses[world], linked[world], env.maps.discovered[world], everyone)
    assert [told.world for told in step.episodes] == [0, 1]
    for told, account in zip(step.episodes, accounts, strict=True):
        for found in account.discovered:  # as shares of this level, not of the one the account is about
            found[:] = 0
        np.testing.assert_allclose(told.drone_curves.sum(axis=0), [*told.curve[9::10], told.curve[-1]], rtol=1e-5)
        account.check(replace(told, drone_curves=np.zeros_like(told.drone_curves)))
        assert told.level == "1"
        assert 0 < told.link_ticks[0] < 45
        assert told.coverage == pytest.approx(told.discovered.sum() / env.maps.coverable_cells[told.world], rel=1e-6)
        assert (told.known >= told.discovered).all()
        assert 1.0 <= told.overlap <= 2.0
        np.testing.assert_array_equal(told.bytes_by, env.air.bytes_sent[told.world])
        assert (told.bytes_by > 0).all()
        believed = (env.maps.belief[told.world] != 0).sum(axis=(1, 2))
        assert (told.cells_by.sum(axis=1) >= believed).all()
        assert (told.cells_by[:, 0] <= told.known).all()
        assert (told.cells_by > 0).any(axis=0)[:2].all()  # of own scans, and of peers'


def test_contacts_are_told_by_kind_as_the_twin_counts_them() -> None:
    explored = ExplorationSettings(
        levels=("0",), worlds=1, drones=2, mirror=False, random_launch=False, episode_ticks=20, stop_coverage=1.0
    )
    env = Exploration(explored, seed=0, restart=False)
    env.reset()
    for _ in range(20):
        step = env.step(np.zeros((1, 2, 2), np.float32))
        env.twin.wall_contacts[0, 1] += 1
        env.twin.mover_contacts[0, 0] += 2
    (told,) = step.episodes
    assert told.contacts_by.tolist() == [[0, 0, 38], [19, 0, 0]]
    assert told.contacts == 57
