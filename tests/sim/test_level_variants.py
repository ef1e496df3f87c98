"""The levels that a batch draws from: which one a seed draws, in which mirror, by which weights."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.sim import level_variants
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import Level, load_level, mirrored
from imagine.sim.level_variants import LevelVariants

NAMES = ("1", "house:3:60", "2")
FLAGS = [(swap, x, y) for swap in (False, True) for x in (False, True) for y in (False, True)]


def same(one: Level, other: Level) -> bool:
    return one.name == other.name and one.fingerprint() == other.fingerprint() and one.grid == other.grid


def test_a_seed_draws_the_level_and_the_mirror_that_it_always_drew() -> None:
    weights = (1.0, 3.0, 0.5)
    env = Exploration(ExplorationSettings(levels=NAMES, level_weights=weights, worlds=1, random_launch=False), 5)
    generator = np.random.default_rng([5, 0])
    shares = np.array(weights) / 4.5
    drawn = set()
    for episode in range(30):
        level = load_level(NAMES[generator.choice(3, p=shares)])  # the first draw is the twin's before any reset
        flags = FLAGS[generator.integers(8)]
        if episode > 0:
            env.reset()
        assert same(env.twin.levels[0], mirrored(level, *flags))
        drawn.add((level.name, flags))
    assert len(drawn) > 10


@pytest.mark.parametrize("name", NAMES)
def test_a_variant_is_the_mirrored_level_and_fits_the_grid(name: str) -> None:
    variants = LevelVariants((name,), mirror=True)
    level = load_level(name)
    for number, flags in enumerate(FLAGS):
        found = variants.get(0, number)
        assert same(found, mirrored(level, *flags))
        assert found.grid[2] <= variants.columns
        assert found.grid[3] <= variants.rows
        np.testing.assert_array_equal(found.coverable, mirrored(level, *flags).coverable)
    assert max(variants.get(0, k).grid[2] for k in range(8)) == variants.columns


def test_an_episode_as_designed_is_the_level_itself_from_its_own_launch_point() -> None:
    env = Exploration(ExplorationSettings(levels=("4",), worlds=40, drones=2, as_designed=0.5), 3)
    env.reset()
    level = load_level("4")
    point = [(pose.x, pose.y, pose.yaw) for pose in level.launch_poses(2, None)]
    designed = [np.allclose(poses, point) for poses in env.twin.poses]
    assert 8 < sum(designed) < 32
    assert all(same(env.twin.levels[world], level) for world in np.flatnonzero(designed))


def test_without_mirrors_levels_are_shown_as_they_are() -> None:
    variants = LevelVariants(("1",), mirror=False)
    generator = np.random.default_rng(0)
    assert {variants.draw(generator, np.ones(1)) for _ in range(20)} == {(0, 0)}
    assert (variants.columns, variants.rows) == load_level("1").grid[2:]


def test_rarely_shown_variants_are_forgotten_unless_somebody_holds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(level_variants, "_KEPT", 2)
    variants = LevelVariants(("1",), mirror=True)
    held, dropped = variants.get(0, 1), weakref.ref(variants.get(0, 2))
    for number in (3, 4, 5):
        variants.get(0, number)
    gc.collect()
    assert dropped() is None
    assert variants.get(0, 1) is held


def test_new_weights_hold_from_the_next_episode_on() -> None:
    settings = ExplorationSettings(levels=("0", "1", "2"), level_weights=(1.0, 0.0, 0.0), worlds=4, episode_ticks=2)
    env = Exploration(settings, 0)
    env.reset()
    env.set_level_weights([0.0, 2.0, 2.0])
    np.testing.assert_array_equal(env.level_weights, [0.0, 0.5, 0.5])
    assert {level.name for level in env.twin.levels} == {"0"}
    names = set()
    for tick in range(12):
        assert env.step(np.zeros((4, 3, 2), np.float32)).done.all() == bool(tick % 2)
        if tick:
            names |= {level.name for level in env.twin.levels}
    assert names == {"1", "2"}


@pytest.mark.parametrize("weights", [(1.0, 2.0), (1.0, -1.0, 1.0), (0.0, 0.0, 0.0), (1.0, float("nan"), 1.0)])
def test_weights_that_are_none_are_refused(weights: tuple[float, ...]) -> None:
    env = Exploration(ExplorationSettings(levels=("0", "1", "2"), worlds=1), 0)
    with pytest.raises(InputError, match="level_weights: give one weight for each of levels"):
        env.set_level_weights(weights)
    np.testing.assert_allclose(env.level_weights, 1 / 3)
