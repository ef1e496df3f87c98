"""Everyone flies the same episodes, however they are batched, and is compared pair by pair."""

from __future__ import annotations

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.evaluation import Comparison, Plan, contender_of, run_episodes, shared_envs
from imagine.train.evaluation.contenders import distinct, named_contender, reference_of
from imagine.train.evaluation.episodes import _SEEDS
from imagine.train.evaluation.plan import Group
from imagine.train.evaluation.rows import bootstrap_interval, paired, ratio_interval
from imagine.train.networks import Actor, NetworkSettings
from imagine.train.pilots import RandomPilot
from imagine.train.policies import policy_of

SHORT = ExplorationSettings(episode_ticks=60, observation=ObservationSpec(view_cells=16, lidar_sectors=16))


class Watched:
    """A pilot that writes down in what worlds it finds itself, and flies as another."""

    def __init__(self, pilot):
        self._pilot, self.name = pilot, pilot.name
        self.launches, self.levels, self.ranges, self.forgotten = [], [], [], []

    def begin(self, env):
        self.launches += list(env.twin.poses.copy())
        self.levels += [level.fingerprint() for level in env.twin.levels]
        self.ranges += list(env.ranges.copy())
        self._pilot.begin(env)

    def forget(self, worlds):
        self.forgotten.append(worlds.copy())
        self._pilot.forget(worlds)

    def act(self, env, observation):
        return self._pilot.act(env, observation)


def network(seed):
    import torch

    torch.manual_seed(seed)
    return policy_of(Actor(NetworkSettings(), SHORT.observation, SHORT.action.size), f"n{seed}", SHORT)


def watched(who, **flown):
    pilot = Watched(contender_of(who, 5).pilot)
    plan = Plan(("1",), episodes=5, launch="random")
    settings = plan.settings(SHORT, "1", Group("one-hop", 2))
    return pilot, run_episodes(pilot, settings, 5, 3, **flown)


def test_episodes_are_the_same_for_everyone():
    (one, _), (other, _), (third, _) = watched("random"), watched("frontier"), watched(network(0))
    for found in (other, third):
        np.testing.assert_array_equal(one.launches, found.launches)
        np.testing.assert_array_equal(one.ranges, found.ranges)  # with the sensor's noise at the launch
        assert one.levels == found.levels
    assert len(set(one.levels)) > 1  # turned and mirrored
    assert len({launch.tobytes() for launch in one.launches}) == 5


@pytest.mark.parametrize("who", ["random", "frontier", network(1)], ids=["random", "frontier", "network"])
def test_an_episode_does_not_depend_on_the_batch_it_flies_in(who):
    (_, together), (_, apart) = watched(who), watched(who, most_worlds=2)
    for one, other in zip(together, apart, strict=True):
        np.testing.assert_array_equal(one.curve, other.curve)
        np.testing.assert_array_equal(one.path_m, other.path_m)
        np.testing.assert_array_equal(one.bytes_by, other.bytes_by)


def test_a_pilot_is_told_once_of_every_world_that_ended():
    pilot, _ = watched("frontier")
    assert np.sum(pilot.forgotten, axis=0).tolist() == [1] * 5


def test_another_seed_is_another_episode_and_none_is_one_of_training():
    plan = Plan(("1",), launch="random")
    settings = plan.settings(SHORT, "1", Group("one-hop", 2))
    first, second = (run_episodes("frontier", settings, 1, seed) for seed in (0, 1))
    assert not np.array_equal(first[0].path_m, second[0].path_m)
    assert first[0].seed == _SEEDS
    assert _SEEDS > 2**31


def test_random_draws_differ_from_world_to_world():
    _, flown = watched(RandomPilot(np.random.default_rng(0)))
    assert len({tuple(episode.path_m) for episode in flown}) == 5


def test_the_ratio_of_known_times_and_its_interval():
    reference = np.random.default_rng(0).uniform(200.0, 800.0, 100)
    low, high = ratio_interval(0.7 * reference, reference, np.random.default_rng(1))
    assert low == pytest.approx(0.7)  # pairs that all say the same leave no doubt, however much the times differ
    assert high == pytest.approx(0.7)
    noisy = 0.7 * reference + np.random.default_rng(2).normal(0.0, 50.0, 100)
    low, high = ratio_interval(noisy, reference, np.random.default_rng(1))
    assert low < noisy.mean() / reference.mean() < high
    spread = 2 * 1.96 * 50.0 / np.sqrt(100) / reference.mean()
    assert high - low == pytest.approx(spread, rel=0.35)


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        below = rng.normal(500.0, 100.0, 40)
        above = 0.8 * below + rng.normal(0.0, 60.0, 40)
        low, high = ratio_interval(above, below, rng)
        hits += low <= 0.8 <= high
    assert 180 <= hits <= 198


def test_thousands_of_episodes_are_resampled_in_parts():
    values = np.random.default_rng(0).normal(1.0, 1.0, 5000)
    low, high = bootstrap_interval(values, np.random.default_rng(1))
    assert high - low == pytest.approx(2 * 1.96 / np.sqrt(5000), rel=0.1)


def test_levels_are_resampled_each_for_itself():
    """Two levels whose means are far apart: pooled, resamples would mix them and the interval be 13 times as wide."""
    rng = np.random.default_rng(0)
    sizes = (40, 10)
    values = np.concatenate([rng.normal(100.0, 10.0, 40), rng.normal(500.0, 10.0, 10)])
    low, high = bootstrap_interval(values, np.random.default_rng(1), sizes)
    expected = 2 * 1.96 * 0.5 * np.sqrt(10.0**2 / 40 + 10.0**2 / 10)
    assert high - low == pytest.approx(expected, rel=0.25)
    assert low < (values[:40].mean() + values[40:].mean()) / 2 < high
    ratios = ratio_interval(values, np.repeat([100.0, 500.0], sizes), np.random.default_rng(1), sizes)
    assert ratios[1] - ratios[0] == pytest.approx((high - low) / 300.0, rel=1e-6)


def test_rows_say_how_they_compare_with_the_reference_level_by_level_and_over_all():
    contenders, reference = reference_of([contender_of("frontier"), contender_of("random")], None)
    plan = Plan(("0", "1"), drones=(2,), episodes=3)
    comparison = Comparison(contenders, shared_envs(contenders, ["env.episode_ticks=120"]), plan, reference)
    flown = [(flight.contender, flight.level) for flight in comparison.fly()]
    assert flown == [(0, "0"), (1, "0"), (0, "1"), (1, "1")]
    rows = comparison.rows
    assert [(row["policy"], row["level"], row["episodes"]) for row in rows] == [
        ("frontier", "0", 3), ("frontier", "1", 3), ("frontier", "all", 6),
        ("random", "0", 3), ("random", "1", 3), ("random", "all", 6),
    ]  # fmt: skip
    assert [row["paired"] is None for row in rows] == [True] * 3 + [False] * 3
    for own, other in zip(rows[3:], rows[:3], strict=True):
        pairs = own["paired"]
        assert pairs["against"] == "frontier"
        assert pairs["t90_ratio"] == pytest.approx(own["t90_mean"] / other["t90_mean"])
        assert pairs["t90_difference"] == pytest.approx(own["t90_mean"] - other["t90_mean"])
        assert pairs["t90_ratio_ci95"][0] <= pairs["t90_ratio"] <= pairs["t90_ratio_ci95"][1]
    assert rows[2]["coverage_mean"] == pytest.approx((rows[0]["coverage_mean"] + rows[1]["coverage_mean"]) / 2)
    assert rows[2]["coverage_min"] == min(rows[0]["coverage_min"], rows[1]["coverage_min"])
    assert rows[4]["paired"]["t90_ratio"] > 1.0


def test_one_compared_with_itself_is_equal():
    plan = Plan(("0",), drones=(1,), episodes=3)
    flown = run_episodes("frontier", plan.settings(SHORT, "0", Group("one-hop", 1)), 3, 0)
    told = paired([flown], [flown], "frontier", SHORT.episode_ticks, 0)
    assert (told["t90_ratio"], told["t90_ratio_ci95"], told["t90_difference"]) == (1.0, (1.0, 1.0), 0.0)


def names(flown, reference):
    return [contender.name for contender in flown], None if reference is None else flown[reference].name


def test_who_is_compared_with_whom():
    frontier, chance, one, two = (contender_of(who) for who in ("frontier", "random", network(1), network(2)))
    assert names(*reference_of([one], None)) == (["n1"], None)
    assert names(*reference_of([frontier, one, chance], None)) == (["frontier", "n1", "random"], "frontier")
    assert names(*reference_of([chance, one], None)) == (["random", "n1"], "random")
    assert names(*reference_of([one, two, frontier], "n1")) == (["n1", "n2", "frontier"], "n1")
    assert names(*reference_of([one], "random")) == (["n1", "random"], "random")
    flown, reference = names(*reference_of([one, two], None))
    assert flown == ["n1", "n2", reference]
    assert reference in ("coordinated", "frontier")


def test_names_are_told_apart(tmp_path):
    one, two = contender_of(network(1)), contender_of(network(1))
    a, b = (type(one)(c.name, c.pilot, c.env, given) for c, given in ((one, "runs/a"), (two, "runs/b")))
    assert [contender.name for contender in distinct([a, b])] == ["runs/a", "runs/b"]
    with pytest.raises(InputError, match=r"runs/a: is given twice"):
        distinct([a, a])


def test_an_unknown_policy_is_named_with_the_nearest():
    with pytest.raises(InputError, match=r"nowhere\.onnx: no such policy"):
        named_contender("nowhere.onnx")
    with pytest.raises(InputError, match="fronteer: no such policy; did you mean 'frontier'"):
        named_contender("fronteer")


def test_a_plan_that_cannot_be_flown_is_refused():
    with pytest.raises(InputError, match="--episodes 0: give 1 or more"):
        Plan(("0",), episodes=0).check()
    with pytest.raises(InputError, match="nothing to evaluate"):
        Plan(()).check()
    with pytest.raises(InputError, match="77"):
        Plan(("0", "77")).check()
