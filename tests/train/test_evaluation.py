import json

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.film import Film
from imagine.sim.metrics import BYTE_KINDS, EpisodeMetrics
from imagine.sim.radio import RadioSettings
from imagine.sim.twin import TICK_S
from imagine.train.evaluation import (
    bootstrap_interval,
    contender_of,
    evaluate,
    evaluation_env,
    row,
    run_episodes,
    shared_envs,
)
from imagine.train.networks import Actor, NetworkSettings
from imagine.train.policies import policy_of

KEYS = [
    "policy", "level", "drones", "protocol", "episodes", "coverage_mean", "coverage_ci95", "coverage_min",
    "coverage_at", "t90_mean", "t90_ci95", "t90_reached", "t95_mean", "t95_reached", "t99_mean", "t99_reached",
    "overlap", "collisions_per_episode", "collisions_per_drone", "path_m", "bytes_per_drone", "bytes_sent",
    "collisions_by_kind", "productivity_ratio", "link_share", "survivors", "paired",
]  # fmt: skip
SHORT = ExplorationSettings(episode_ticks=150, observation=ObservationSpec(view_cells=16, lidar_sectors=16))


def test_a_row_for_each_level_and_team_with_the_documented_keys():
    rows = evaluate("frontier", ["0", "1"], drones=(1, 2), episodes=2, seed=4, env=SHORT)
    assert [(row["level"], row["drones"]) for row in rows] == [("0", 1), ("1", 1), ("0", 2), ("1", 2)]
    assert all(list(row) == KEYS for row in rows)
    assert json.loads(json.dumps(rows)) is not None
    assert rows[0]["coverage_mean"] > 0.95
    alone, together = rows[0]["bytes_sent"], rows[2]["bytes_sent"]
    assert [kind for kind in BYTE_KINDS if alone[kind] > 0.0] == ["status"]  # for the ground: no peer to tell more
    assert all(together[kind] > 0.0 for kind in BYTE_KINDS)


def test_equal_seeds_give_equal_rows():
    first, second = (evaluate("random", ["1"], drones=(2,), episodes=3, seed=7, env=SHORT) for _ in range(2))
    assert first == second


def test_the_planner_beats_chance():
    frontier, random = (evaluate(name, ["2"], episodes=2, env=SHORT)[0] for name in ("frontier", "random"))
    assert frontier["coverage_mean"] > random["coverage_mean"] + 0.2


def test_a_network_flies_and_protocol_off_shares_no_maps():
    actor = Actor(NetworkSettings(), SHORT.observation, 2)
    (row,) = evaluate(policy_of(actor, "untrained", SHORT), ["0"], drones=(2,), protocol="off", episodes=2)
    assert row["policy"] == "untrained"
    assert row["episodes"] == 2
    assert [kind for kind in BYTE_KINDS if row["bytes_sent"][kind] > 0.0] == ["status"]


def episode(coverage=0.5, t90=None, **changes):
    zeros = np.zeros(2, np.int64)
    given = {
        "world": 0, "seed": 0, "level": "x", "ticks": 500, "coverage": coverage,
        "curve": np.full(500, coverage, np.float32), "t90": t90, "t95": None, "t99": None, "overlap": 1.5,
        "path_m": np.array([2.0, 4.0]), "discovered": zeros, "drone_curves": np.zeros((2, 1), np.float32),
        "known": zeros, "contacts": 1, "link_ticks": zeros, "pair_ticks": np.zeros((2, 2), np.int64),
        "alive_ticks": zeros + 500, "contacts_by": np.array([[1, 0, 0], [0, 0, 0]]),
        "bytes_by": np.zeros((2, 4), np.int64), "cells_by": np.zeros((2, 3), np.int64),
    }  # fmt: skip
    return EpisodeMetrics(**(given | changes))


def row_of(*episodes):
    return row("p", "x", 2, "one-hop", [episodes], SHORT.episode_ticks, 0)


def test_an_episode_that_never_gets_there_counts_with_its_full_length():
    numbers = row_of(episode(0.95, 100), episode(0.5, None))
    assert numbers["t90_mean"] == (100 + 150) / 2
    assert numbers["t90_reached"] == 0.5
    assert numbers["t95_reached"] == 0.0
    assert numbers["t99_mean"] == 150.0
    assert numbers["path_m"] == 3.0
    assert numbers["collisions_per_episode"] == 1.0
    assert numbers["collisions_per_drone"] == 0.5
    assert numbers["coverage_min"] == 0.5
    low, high = numbers["t90_ci95"]
    assert (low, high) == (100.0, 150.0)


def test_every_level_counts_alike_however_many_episodes_it_has():
    """And the interval is of the episodes on these levels: that levels differ is not chance."""
    easy, hard = [episode(0.95, 40, contacts=0)] * 8, [episode(0.91, 120, contacts=4)] * 2
    numbers = row("p", "all", 2, "one-hop", [easy, hard], SHORT.episode_ticks, 0)
    assert numbers["episodes"] == 10
    assert numbers["t90_mean"] == 80.0
    assert numbers["t90_ci95"] == (80.0, 80.0)
    assert numbers["coverage_mean"] == pytest.approx(0.93)
    assert numbers["coverage_ci95"] == pytest.approx((0.93, 0.93))
    assert numbers["coverage_at"]["100"] == pytest.approx(0.93)
    assert numbers["collisions_per_episode"] == 2.0
    assert numbers["coverage_min"] == 0.91


def test_coverage_is_told_at_ticks_that_episodes_last_and_stays_after_an_end():
    ended = episode(0.8, ticks=50, curve=np.linspace(0.016, 0.8, 50).astype(np.float32))
    longer = episode(0.4, ticks=150, curve=np.linspace(0.4 / 150, 0.4, 150).astype(np.float32))
    assert row_of(ended, longer)["coverage_at"] == {"100": pytest.approx((0.8 + 0.4 * 100 / 150) / 2, abs=1e-6)}


def test_bytes_are_told_for_a_drone_by_kind():
    counted = row_of(episode(bytes_by=np.array([[1, 2, 3, 4], [5, 6, 7, 8]])), episode(bytes_by=np.full((2, 4), 10)))
    assert counted["bytes_sent"] == dict(zip(BYTE_KINDS, [6.5, 7.0, 7.5, 8.0], strict=True))
    assert counted["bytes_per_drone"] == sum(counted["bytes_sent"].values())


def test_contacts_are_told_for_the_team_by_kind():
    told = np.array([[1, 2, 0], [3, 0, 0]])
    both = row_of(episode(contacts_by=told), episode(contacts_by=0 * told))
    assert both["collisions_by_kind"] == {"wall": 2.0, "drone": 1.0, "mover": 0.0}


def test_what_is_told_of_bytes_is_what_the_radio_sent():
    settings = SHORT.model_copy(update={"levels": ("1",), "drones": 2, "mirror": False, "random_launch": False})
    flown = run_episodes("frontier", settings, 1, 3)
    told = row("frontier", "1", 2, "one-hop", [flown], settings.episode_ticks, 0)["bytes_sent"]
    budget = RadioSettings().rate_bps / 8.0 * TICK_S * flown[0].ticks + MeshSettings().burst_bytes
    assert all(told[kind] > 0.0 for kind in BYTE_KINDS)
    assert sum(told.values()) <= budget


def test_what_the_team_is_like_is_averaged_over_episodes():
    one = episode(discovered=np.array([80, 10]), link_ticks=np.array([500, 250]))
    other = episode(discovered=np.array([20, 10]), alive_ticks=np.array([500, 499]))
    told = row_of(one, other)
    assert told["productivity_ratio"] == pytest.approx(4.0)  # of 8 and 2
    assert told["link_share"] == pytest.approx((0.75 + 0.0) / 2)
    assert told["survivors"] == pytest.approx(0.75)


def test_filming_shows_the_first_episode_to_its_end_and_changes_no_result():
    settings = SHORT.model_copy(update={"levels": ("0",), "drones": 2, "mirror": False, "random_launch": False})
    film = Film(200)
    filmed = run_episodes("random", settings, 3, 1, film)
    plain = run_episodes("random", settings, 3, 1)
    assert [told.ticks for told in filmed] == [told.ticks for told in plain]
    for one, other in zip(filmed, plain, strict=True):
        np.testing.assert_array_equal(one.curve, other.curve)
    *_, last = film.scenes
    assert last.tick == filmed[0].ticks
    assert last.coverage == pytest.approx(filmed[0].coverage, abs=1e-6)
    assert next(film.scenes).tick == 0


def test_of_several_rows_the_first_is_filmed():
    film = Film(200)
    rows = evaluate("frontier", ["1", "0"], drones=(2,), episodes=1, env=SHORT, film=film)
    assert len(rows) == 2
    assert {scene.level.name for scene in film.scenes} == {"1"}


def test_the_interval_holds_the_mean_and_narrows_with_more_episodes():
    rng = np.random.default_rng(0)
    few, many = rng.normal(0.5, 0.1, 10), rng.normal(0.5, 0.1, 1000)
    low, high = bootstrap_interval(few, np.random.default_rng(1))
    assert low < few.mean() < high
    narrow_low, narrow_high = bootstrap_interval(many, np.random.default_rng(1))
    assert narrow_high - narrow_low == pytest.approx(4 * 0.1 / np.sqrt(1000), rel=0.15)
    assert narrow_high - narrow_low < high - low


def test_all_levels_are_loaded_before_any_is_flown(tmp_path):
    closet = tmp_path / "closet.yaml"
    closet.write_text("{size_m: [2, 2], launch: [1, 1]}")
    for wrong, said in (("77", "unknown level '77'"), (str(closet), "room for")):
        told = []
        with pytest.raises(InputError, match=said):
            evaluate("random", ["0", wrong], drones=(1, 16), episodes=1, env=SHORT, progress=told.append)
        assert told == []


def test_overrides_are_laid_over_what_the_policy_was_made_for():
    made_for = SHORT.model_copy(update={"episode_ticks": 70})
    policy = contender_of(policy_of(Actor(NetworkSettings(), SHORT.observation, 2), "mine", made_for))
    changed = evaluation_env(policy, ["env.dynamics.wind_mps=0.5", "env.budget_bytes_per_s=2000"])
    assert changed.dynamics.wind_mps == 0.5
    assert changed.mesh.rate_bytes_per_s == 2000.0
    assert changed.observation == SHORT.observation
    assert changed.episode_ticks == 70
    assert evaluation_env(policy) == made_for
    assert evaluation_env(contender_of("frontier"), ["env.episode_ticks=9"]) == ExplorationSettings(episode_ticks=9)


def test_an_override_changes_what_is_flown():
    calm, windy = (
        evaluate(
            "random",
            ["1"],
            drones=(2,),
            episodes=1,
            env=evaluation_env(contender_of("random"), ["env.episode_ticks=60", *more]),
        )
        for more in ([], ["env.dynamics.wind_mps=0.5"])
    )
    assert calm[0]["path_m"] != windy[0]["path_m"]


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("env.dynamics.wind_mp=1", r"unknown key 'env\.dynamics\.wind_mp'; did you mean 'wind_mps'"),
        ("wind_mps=1", "unknown key 'wind_mps'; valid keys: env"),
        ("env.drones=2", "sets drones itself: give --drones"),
        ("env.mirror=true", "sets mirror itself"),
        ("env.observation.view_cells=24", r"env\.observation: mine was made for another"),
        ("env.action.mode=body", r"env\.action: mine was made for another"),
        ("env", "key=value"),
    ],
)
def test_overrides_that_cannot_be_are_refused(override, said):
    policy = policy_of(Actor(NetworkSettings(), SHORT.observation, 2), "mine", SHORT)
    with pytest.raises(InputError, match=said):
        evaluation_env(contender_of(policy), [override])


def network(name, env):
    return contender_of(policy_of(Actor(NetworkSettings(), env.observation, env.action.size), name, env))


def test_all_fly_the_environment_of_the_first_network_each_with_its_own_eyes():
    first = SHORT.model_copy(update={"episode_ticks": 70})
    second = ExplorationSettings(observation=ObservationSpec(view_cells=24))
    envs = shared_envs([contender_of("frontier"), network("a", first), network("b", second)], ["env.stop_coverage=0.9"])
    assert [env.episode_ticks for env in envs] == [70, 70, 70]
    assert [env.stop_coverage for env in envs] == [0.9, 0.9, 0.9]
    assert [env.observation.view_cells for env in envs] == [32, 16, 24]  # planners need none, and get the default


def test_networks_for_different_sensors_are_not_compared():
    other = SHORT.model_copy(update={"lidar_beams": 90})
    with pytest.raises(InputError, match="b: was made for another lidar_beams than a"):
        shared_envs([network("a", SHORT), network("b", other)])
