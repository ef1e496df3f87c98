import json

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import EpisodeMetrics
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.evaluation import bootstrap_interval, evaluate, named_policy, row
from imagine.train.networks import Actor, NetworkSettings
from imagine.train.policies import policy_of

KEYS = [
    "policy", "level", "drones", "protocol", "episodes", "coverage_mean", "coverage_ci95", "t90_mean", "t90_reached",
    "t95_mean", "t95_reached", "overlap", "collisions_per_episode", "path_m", "bytes_per_drone",
]  # fmt: skip
SHORT = ExplorationSettings(episode_ticks=150, observation=ObservationSpec(view_cells=16, lidar_sectors=16))


def test_a_row_for_each_level_and_team_with_the_documented_keys():
    rows = evaluate("frontier", ["0", "1"], drones=(1, 2), episodes=2, seed=4, env=SHORT)
    assert [(row["level"], row["drones"]) for row in rows] == [("0", 1), ("0", 2), ("1", 1), ("1", 2)]
    assert all(list(row) == KEYS for row in rows)
    assert json.loads(json.dumps(rows)) is not None
    assert rows[0]["coverage_mean"] > 0.95
    assert rows[0]["bytes_per_drone"] == 0.0  # nobody to talk to
    assert rows[1]["bytes_per_drone"] > 0.0


def test_equal_seeds_give_equal_rows():
    first, second = (evaluate("random", ["1"], drones=(2,), episodes=3, seed=7, env=SHORT) for _ in range(2))
    assert first == second


def test_the_planner_beats_chance():
    frontier, random = (evaluate(name, ["2"], episodes=2, env=SHORT)[0] for name in ("frontier", "random"))
    assert frontier["coverage_mean"] > random["coverage_mean"] + 0.2


def test_a_network_flies_and_protocol_off_sends_nothing():
    actor = Actor(NetworkSettings(), SHORT.observation, 2)
    (row,) = evaluate(policy_of(actor, "untrained", SHORT), ["0"], drones=(2,), protocol="off", episodes=2)
    assert row["policy"] == "untrained"
    assert row["episodes"] == 2
    assert row["bytes_per_drone"] == 0.0


def episode(coverage, t90):
    zeros = np.zeros(2, np.int64)
    curve = np.array([coverage], np.float32)
    return EpisodeMetrics(0, "x", 500, coverage, curve, t90, None, 1, np.array([2.0, 4.0]), zeros, zeros + 10, 1.5)


def test_an_episode_that_never_gets_there_counts_with_its_full_length():
    numbers = row("p", "x", 2, "one-hop", [episode(0.95, 100), episode(0.5, None)], SHORT, 0)
    assert numbers["t90_mean"] == (100 + 150) / 2
    assert numbers["t90_reached"] == 0.5
    assert numbers["t95_reached"] == 0.0
    assert numbers["path_m"] == 3.0
    assert numbers["collisions_per_episode"] == 1.0


def test_the_interval_holds_the_mean_and_narrows_with_more_episodes():
    rng = np.random.default_rng(0)
    few, many = rng.normal(0.5, 0.1, 10), rng.normal(0.5, 0.1, 1000)
    low, high = bootstrap_interval(few, np.random.default_rng(1))
    assert low < few.mean() < high
    narrow_low, narrow_high = bootstrap_interval(many, np.random.default_rng(1))
    assert narrow_high - narrow_low == pytest.approx(4 * 0.1 / np.sqrt(1000), rel=0.15)
    assert narrow_high - narrow_low < high - low


def test_an_unknown_policy_or_level_is_named():
    with pytest.raises(InputError, match=r"nowhere\.onnx: no such policy"):
        named_policy("nowhere.onnx")
    with pytest.raises(InputError, match="77"):
        evaluate("random", ["77"], episodes=1)
