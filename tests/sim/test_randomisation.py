"""Ranges in the environment's settings: what every world and episode draws, and that it is all its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.config import check_settings
from imagine.core.errors import InputError
from imagine.core.lidar import LD19
from imagine.sim.air import BUDGET, CLEAR_M, LOSS
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.lidar_model import DARK_RANGE, DARK_SHARE, DROPOUT, MISSES, STD, STD_PER_M, LidarModel, sensor_numbers
from imagine.sim.odometry_drift import DriftSettings, OdometryDrift
from imagine.sim.plain.exploration import PlainExploration
from imagine.sim.radio import RadioMedium, RadioSettings
from imagine.sim.randomisation import draw, ends

WORLDS, EPISODES = 4, 6
SENSING = {
    "noise_std_m": [0.01, 0.03], "noise_per_m": [0.0, 0.01], "noise_scale": [0.5, 2.0], "dropout": [0.0, 0.1],
    "miss_at_max": [0.0, 0.3], "dark_share": [0.0, 0.2], "dark_range_m": [1.0, 3.0],
}  # fmt: skip
EVERYTHING: dict[str, Any] = {
    "levels": ["1"], "worlds": WORLDS, "drones": 2, "episode_ticks": 3, "sensing": SENSING,
    "radio": {"range_m": [3.0, 8.0], "loss": [0.0, 0.4]}, "budget_bytes_per_s": [2000.0, 30000.0],
    "drift": {"enabled": True, "share": 0.5}, "dynamics": {"lag_s": [0.1, 0.3], "wind_mps": [0.0, 0.2]},
}  # fmt: skip


def environment(settings: dict[str, Any], seed: int = 4, **more: Any) -> Exploration:
    return Exploration(check_settings(ExplorationSettings, settings, "env"), seed, **more)


def drawn(env: Exploration) -> list[NDArray[np.float64]]:
    """Return what every episode of every world has drawn, `[worlds, numbers]` for each of EPISODES."""
    env.reset()
    episodes = []
    still = np.zeros((env.worlds, env.drones, env.settings.action.size), np.float32)
    for _ in range(EPISODES):
        media = env.air.state.media
        drifts = np.zeros(env.worlds) if env._drift is None else env._drift._drifts.astype(float)
        dynamics = env.twin.drawn_dynamics.reshape(env.worlds, -1)
        numbers = env.twin.sensors(4.0).numbers
        episodes.append(np.column_stack((media, drifts, numbers, dynamics)))
        done = np.zeros(env.worlds, bool)
        while not done.all():
            done |= env.step(still).done
    return episodes


def test_every_world_and_episode_draws_its_own_within_bounds() -> None:
    env = environment(EVERYTHING)
    rows = np.concatenate(drawn(env))
    sensors = 8  # seven columns of the medium, and whether poses drift
    spans = {
        BUDGET: (2000.0, 30000.0), LOSS: (0.0, 0.4), CLEAR_M: (3.0, 8.0), sensors + DROPOUT: (0.0, 0.1),
        sensors + STD: (0.005, 0.06), sensors + STD_PER_M: (0.0, 0.02), sensors + DARK_SHARE: (0.0, 0.2),
        sensors + MISSES: (0.0, 0.3 / LD19.range_max**2), sensors + DARK_RANGE: (1.0, 3.0),
    }  # fmt: skip
    for column, (low, high) in spans.items():
        assert len(set(rows[:, column])) == WORLDS * EPISODES, column
        assert low <= rows[:, column].min(), column
        assert rows[:, column].max() <= high, column
        assert np.ptp(rows[:, column]) > 0.4 * (high - low), column
    assert 0.2 < rows[:, 7].mean() < 0.8  # in half of the episodes


def test_a_world_draws_the_same_alone_as_in_a_batch_and_again() -> None:
    batch, again = drawn(environment(EVERYTHING)), drawn(environment(EVERYTHING))
    other = drawn(environment(EVERYTHING, seed=5))
    for world in range(WORLDS):
        alone = drawn(environment(EVERYTHING | {"worlds": 1}, world_keys=[world]))
        for episode in range(EPISODES):
            np.testing.assert_array_equal(alone[episode][0], batch[episode][world])
            np.testing.assert_array_equal(again[episode][world], batch[episode][world])
            assert not np.array_equal(other[episode][world], batch[episode][world])


def test_without_ranges_nothing_is_drawn() -> None:
    plain = {key: EVERYTHING[key] for key in ("levels", "worlds", "drones", "episode_ticks")}
    fixed = plain | {
        "radio": {"range_m": 5.0, "loss": 0.0}, "sensing": {"noise_scale": 1.0, "dropout": 0.0, "dark_share": 0.0},
        "drift": {"enabled": False, "share": 0.5},
    }  # fmt: skip
    one, other = environment(plain), environment(fixed)
    for a, b in zip(drawn(one), drawn(other), strict=True):
        np.testing.assert_array_equal(a, b)
    states = [[g.bit_generator.state for g in env._episodes.generators] for env in (one, other)]
    assert states[0] == states[1]


def test_a_flight_draws_its_radio_once() -> None:
    settings = RadioSettings(range_m=(2.0, 9.0), loss=(0.1, 0.9))
    media = [RadioMedium(2, settings, np.random.default_rng(seed)).settings for seed in (0, 0, 1)]
    assert media[0] == media[1] != media[2]
    for medium in media:
        assert isinstance(medium.range_m, float)
        assert 2.0 <= medium.range_m <= 9.0
        assert 0.1 <= ends(medium.loss)[0] == ends(medium.loss)[1] <= 0.9
        assert medium.propagation.clear_m == medium.range_m
    assert settings.propagation.clear_m == 5.5
    rng = np.random.default_rng(0)
    assert RadioSettings().drawn(rng) == RadioSettings()
    assert rng.random() == np.random.default_rng(0).random()


def test_radios_reach_as_far_as_their_world_drew() -> None:
    env = environment(EVERYTHING | {"levels": ["6"], "worlds": 40, "random_launch": False, "episode_ticks": 1000})
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(60):
        actions = rng.uniform(-1.0, 1.0, (40, 2, env.settings.action.size)).astype(np.float32)
        actions[:, 1] = -actions[:, 0]  # apart from each other
        env.step(actions)
    apart = np.hypot(*(env.twin.poses[:, 0, :2] - env.twin.poses[:, 1, :2]).T)
    np.testing.assert_array_equal(env.air.state.reach[:, 0, 1] == 1, apart <= env.air.state.media[:, CLEAR_M])


def test_less_budget_is_less_said() -> None:
    short = {"budget_bytes_per_s": [100.0, 1500.0]}
    env = environment(EVERYTHING | {"worlds": 24, "episode_ticks": 1000, "radio": {"range_m": 50.0}} | short)
    env.reset()
    for _ in range(120):
        env.step(np.nan_to_num(env.planner_actions()))
    budget, said = env.air.state.media[:, BUDGET], env.air.bytes_sent.sum(axis=-1).max(axis=1)
    burst = env.settings.mesh.burst_bytes
    assert (said <= burst + 12.1 * budget).all()
    tight = budget < np.median(budget)
    assert said[tight].mean() < said[~tight].mean()


def test_episodes_without_drift_know_their_poses_exactly() -> None:
    drift = OdometryDrift(64, 2, DriftSettings(enabled=True, share=0.5), 0.1)
    rng = np.random.default_rng(0)
    for world in range(64):
        drift.reset(world, np.random.default_rng(world))
    poses = rng.uniform(-3.0, 3.0, (64, 2, 3))
    exact = np.ones(64, bool)
    for _ in range(5):
        poses += rng.normal(0.0, 0.05, poses.shape)
        poses[..., 2] = np.remainder(poses[..., 2] + np.pi, 2.0 * np.pi) - np.pi
        exact &= (drift.advance(poses) == poses).all(axis=(1, 2))
    np.testing.assert_array_equal(exact, ~drift._drifts)
    assert 16 < exact.sum() < 48


@given(st.floats(-5.0, 5.0), st.floats(0.0, 5.0), st.integers(0, 100))
def test_a_draw_lies_in_its_range(low: float, width: float, seed: int) -> None:
    high = low + width
    assert low <= draw((low, high), np.random.default_rng(seed)) <= high
    assert low <= draw((low, high), None) <= high
    rng = np.random.default_rng(seed)
    assert draw(low, rng) == low
    assert rng.random() == np.random.default_rng(seed).random()


def test_the_middle_stands_for_a_range_where_nothing_is_drawn() -> None:
    model = LidarModel(noise_std_m=(0.01, 0.03), noise_scale=(1.0, 3.0), dropout=(0.0, 0.2))
    numbers = sensor_numbers(model, LD19)
    assert numbers[STD] == pytest.approx(0.04)
    assert numbers[DROPOUT] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("group", "key", "value", "message"),
    [
        ("sensing", "dropout", [0.3, 0.1], "within 0 and 1"),
        ("sensing", "dark_share", [0.1, 1.1], "within 0 and 1"),
        ("sensing", "dark_range_m", [0.0, 2.0], "greater than 0"),
        ("sensing", "noise_std_m", 1.5, "within 0 and 1"),
        ("radio", "range_m", [8.0, 3.0], "greater than 0"),
        ("radio", "range_m", -1.0, "greater than 0"),
        ("radio", "loss", [0.0, 1.5], "within 0 and 1"),
        ("radio", "tx_dbm", [-70.0, 0.0], "within -60 and 40"),
        ("drift", "share", 1.5, "less than or equal to 1"),
    ],
)
def test_a_range_out_of_bounds_is_refused_by_its_key(group: str, key: str, value: Any, message: str) -> None:
    with pytest.raises(InputError) as error:
        environment({group: {key: value}})
    assert f"env: {group}.{key}: " in str(error.value)
    assert message in str(error.value)


def test_a_budget_must_be_something() -> None:
    with pytest.raises(InputError, match="budget_bytes_per_s: give a number, or a range"):
        environment({"budget_bytes_per_s": [0.0, 100.0]})


def test_plain_exploration_says_that_it_draws_no_radio() -> None:
    with pytest.raises(InputError, match="no ranges of radio or budget"):
        PlainExploration(ExplorationSettings(levels=("0",), radio=RadioSettings(loss=(0.0, 0.1))), 0)
