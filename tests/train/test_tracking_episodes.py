"""The window of newest episodes."""

from dataclasses import replace

import numpy as np
import pytest

from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import pack, unpack
from imagine.train.report import Report, one_line
from imagine.train.tracking.episodes import (
    DRONE_METRICS,
    RECENT_EPISODES,
    TEAM_METRICS,
    RecentEpisodes,
    drone_metrics,
    team_metrics,
)
from imagine.train.tracking.level_groups import MOST_FILES, LevelGroups

TICKS = 60


@pytest.fixture(scope="module")
def episodes():
    """Real episodes of two drones, flown by chance."""
    settings = ExplorationSettings(levels=("1",), worlds=3, drones=2, episode_ticks=TICKS)
    env, rng = Exploration(settings, 0), np.random.default_rng(0)
    env.reset()
    found = []
    while len(found) < 3:
        actions = rng.uniform(-1.0, 1.0, (3, 2, settings.action.size)).astype(np.float32)
        found += env.step(actions).episodes
    return found[:3]


def test_an_episode_is_told_by_all_its_metrics(episodes):
    episode = episodes[0]
    team = dict(zip(TEAM_METRICS, team_metrics(episode, TICKS), strict=True))
    assert team["coverage"] == pytest.approx(episode.coverage)
    assert team["t99"] == TICKS
    assert team["bytes"] == pytest.approx(episode.total_bytes / 2)
    assert team["bytes"] == pytest.approx(sum(team[f"bytes_{kind}"] for kind in ("scan", "tile", "digest", "status")))
    assert team["contacts"] == team["contacts_wall"] + team["contacts_drone"] + team["contacts_mover"]
    assert team["coverage_area"] == pytest.approx(episode.curve.mean())
    assert team["coverage_300"] == pytest.approx(episode.coverage)
    drones = drone_metrics(episode)
    assert drones.shape == (2, len(DRONE_METRICS))
    assert drones[:, DRONE_METRICS.index("discovered_share")].sum() == pytest.approx(1.0)
    np.testing.assert_allclose(drones[:, DRONE_METRICS.index("path_m")].mean(), team["path_m"])
    assert np.isfinite(drones).all()


def test_an_explored_level_stays_explored(episodes):
    curve = np.array([0.5, 1.0], np.float32)
    done = replace(episodes[0], curve=curve, ticks=2, coverage=1.0, t90=2, t95=2, t99=2, alive_ticks=np.array([2, 2]))
    team = dict(zip(TEAM_METRICS, team_metrics(done, 10), strict=True))
    assert team["coverage_area"] == pytest.approx(0.95)
    assert (team["t90"], team["t90_reached"], team["survivors"]) == (2.0, 1.0, 1.0)


def test_only_the_newest_episodes_count(episodes):
    recent = RecentEpisodes(TICKS)
    recent.add(replace(episodes[0], coverage=k / 1000) for k in range(RECENT_EPISODES + 30))
    newest = np.arange(30, RECENT_EPISODES + 30) / 1000
    assert recent.means()["1"]["coverage"] == pytest.approx(newest.mean())
    assert recent.summary()["1"] == {"coverage": pytest.approx(newest.mean()), "t90": TICKS, "contacts": 0.0}


def test_ratios_are_averaged_as_ratios(episodes):
    recent = RecentEpisodes(TICKS)
    recent.add(replace(episodes[0], discovered=np.array(found)) for found in ((100, 400), (100, 100)))
    assert recent.means()["1"]["productivity_ratio"] == pytest.approx(2.0)


def test_drones_are_averaged_over_levels_alike(episodes):
    recent = RecentEpisodes(TICKS)
    recent.add(replace(episodes[0], level="0", path_m=np.array([1.0, 3.0])) for _ in range(5))
    recent.add([replace(episodes[0], level="house:3:60", path_m=np.array([2.0, 8.0]))])
    assert recent.means().keys() == {"0", "house"}
    assert recent.drone_means()["0"]["path_m"] == pytest.approx(1.5)
    assert recent.drone_means()["1"]["path_m"] == pytest.approx(5.5)


def test_before_the_first_episode_there_is_nothing():
    assert RecentEpisodes(TICKS).means() == {}
    assert RecentEpisodes(TICKS).drone_means() == {}


@pytest.mark.parametrize("count", [3, RECENT_EPISODES, RECENT_EPISODES + 17])
def test_a_window_that_was_saved_goes_on_bit_for_bit(episodes, count):
    rng = np.random.default_rng(1)
    many = [replace(episodes[k % 3], coverage=float(c)) for k, c in enumerate(rng.random(count + 20))]
    whole, before, after = RecentEpisodes(TICKS), RecentEpisodes(TICKS), RecentEpisodes(TICKS)
    whole.add(many)
    before.add(many[:count])
    after.load_state_dict(unpack(pack(before.state_dict())))
    after.add(many[count:])
    assert after.means() == whole.means()
    assert after.drone_means() == whole.drone_means()


def test_levels_are_counted_under_few_names():
    group = LevelGroups()
    assert [group(name) for name in ("0", "6", "house:7", "house:12:60", "house:1:88.5")] == ["0", "6", *["house"] * 3]
    named = ("maps/my flat.yaml", "my flat", "maps/plan.v2.json", "maps/hall.PNG@0.05", "hall")
    assert [group(name) for name in named] == ["my_flat", "my_flat", "plan.v2", "hall", "hall"]


def test_many_files_are_counted_as_one():
    plans = [f"plans/{k:02}.json" for k in range(10, 10 + MOST_FILES)]
    assert LevelGroups(plans)("12") == "12"
    group = LevelGroups([*plans, "plans/more.json", "4", "house:3"])
    assert [group(name) for name in ("12", "plans/more.json", "4", "house:9")] == ["files", "files", "4", "house"]


@pytest.mark.parametrize(
    ("stop", "missing"),
    [(0.995, set()), (0.92, {"t95", "t99"}), (0.5, {"t90", "t90_reached", "t95", "t99"})],
)
def test_times_to_coverages_at_which_no_episode_arrives_are_left_out(episodes, stop, missing):
    """They are not measured: the full length would say that the policy never gets there."""
    recent = RecentEpisodes(TICKS, stop_coverage=stop)
    recent.add(replace(episode, coverage=stop, t90=None if stop < 0.9 else 20) for episode in episodes)
    means = recent.means()["1"]
    assert set(TEAM_METRICS) - means.keys() == missing
    assert recent.summary()["1"].keys() == {"coverage", "t90", "contacts"} - missing
    report = Report("ppo", 1, 1, 2, {}, recent.means(), 1.0, {"update": 1.0}, 1.0)
    assert missing.isdisjoint(name.rpartition("/")[2] for name in report.scalars())
    assert f"1:{stop:.2f}/{'-' if stop < 0.9 else 20}" in one_line(report)
