"""The PettingZoo face of exploration: it keeps to the API, and to the world behind it."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="PettingZoo is not installed: it comes with the extra 'train'")

from pettingzoo.test import parallel_api_test

from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.parallel_env import ExplorationEnv

SMALL = ExplorationSettings(
    levels=("0",), drones=2, episode_ticks=40, mirror=False, observation=ObservationSpec(view_cells=16)
)


def random_actions(env: ExplorationEnv, rng: np.random.Generator) -> dict[str, Any]:
    return {agent: rng.uniform(-1.0, 1.0, env.action_space(agent).shape).astype(np.float32) for agent in env.agents}


def fly(env: ExplorationEnv, seed: int | None, ticks: int = 15) -> list[Any]:
    """Return everything the environment said in a few ticks of the same random flying."""
    rng = np.random.default_rng(5)
    told: list[Any] = [env.reset(seed=seed)]
    told += [env.step(random_actions(env, rng)) for _ in range(ticks)]
    return told


def flat(told: Any) -> list[Any]:
    if isinstance(told, dict):
        return [key for item in told.items() for key in flat(item)]
    if isinstance(told, (list, tuple)):
        return [leaf for item in told for leaf in flat(item)]
    return [told.tobytes() if isinstance(told, np.ndarray) else told]


@pytest.mark.parametrize("mode", ["plane", "body"])
@pytest.mark.filterwarnings("error")
def test_it_passes_pettingzoos_own_test(mode: str) -> None:
    parallel_api_test(ExplorationEnv(SMALL.model_copy(update={"action": ActionSpec(mode=mode)})), num_cycles=45)


def test_the_seed_decides_everything() -> None:
    env = ExplorationEnv(SMALL, seed=3)
    first, second = fly(env, seed=3), fly(env, seed=3)
    assert flat(first) == flat(second) == flat(fly(ExplorationEnv(SMALL), seed=3))
    assert flat(fly(ExplorationEnv(SMALL, seed=3), seed=None)) == flat(first)
    assert flat(fly(env, seed=4)) != flat(first)


def test_without_a_seed_every_episode_is_another_one() -> None:
    env = ExplorationEnv(SMALL)
    first, _ = env.reset(seed=1)
    second, _ = env.reset()
    assert flat(first) != flat(second)


def test_what_it_says_lies_in_its_spaces() -> None:
    env = ExplorationEnv(SMALL)
    rng = np.random.default_rng(0)
    observations, infos = env.reset(seed=0)
    while True:
        assert all(env.observation_space(agent).contains(seen) for agent, seen in observations.items())
        assert {agent: list(seen) for agent, seen in observations.items()} == {
            agent: ["views", "lidar", "motion"] for agent in env.possible_agents
        }
        assert env.state_space.contains(env.state())
        assert len({info["coverage"] for info in infos.values()}) == 1
        if not env.agents:
            break
        observations, _, _, _, infos = env.step(random_actions(env, rng))


def test_an_episode_is_truncated_at_its_length_and_nothing_of_the_next_one_shows() -> None:
    env = ExplorationEnv(SMALL.model_copy(update={"stop_coverage": 1.0}))
    _, infos = env.reset(seed=0)
    zero = {agent: np.zeros(2, np.float32) for agent in env.agents}
    coverage = infos["drone_1"]["coverage"]
    for tick in range(1, SMALL.episode_ticks + 1):
        observations, rewards, terminations, truncations, infos = env.step(zero)
        assert infos["drone_2"]["ticks"] == tick
        assert infos["drone_2"]["coverage"] >= coverage
        coverage = infos["drone_2"]["coverage"]
        assert not any(terminations.values())
        assert all(truncations.values()) == (tick == SMALL.episode_ticks)
    assert env.agents == []
    assert set(observations) == set(rewards) == {"drone_1", "drone_2"}
    # The last observation still is of this episode: had the world started anew, its maps would hold a single scan.
    free = (observations["drone_1"]["views"][0] <= -0.5).mean()
    assert free > 0.1
    with pytest.raises(InputError, match="reset"):
        env.step(zero)


def test_a_covered_level_terminates() -> None:
    env = ExplorationEnv(SMALL.model_copy(update={"stop_coverage": 0.05}))
    env.reset(seed=0)
    _, _, terminations, truncations, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    assert all(terminations.values())
    assert not any(truncations.values())
    assert infos["drone_1"]["coverage"] >= 0.05


def test_it_is_the_world_that_policies_are_trained_in() -> None:
    settings = SMALL.model_copy(update={"worlds": 1})
    world, env = Exploration(settings, seed=9), ExplorationEnv(settings)
    rng = np.random.default_rng(1)
    expected = world.reset()
    observations, _ = env.reset(seed=9)
    for _ in range(10):
        for drone, agent in enumerate(env.agents):
            for name, array in expected.policy.items():
                np.testing.assert_array_equal(observations[agent][name], array[0, drone])
        actions = random_actions(env, rng)
        step = world.step(np.stack(list(actions.values()))[None])
        observations, rewards, _, _, _ = env.step(actions)
        assert list(rewards.values()) == step.reward[0].tolist()
        expected = step.observation


def test_wrong_actions_are_refused_by_name() -> None:
    env = ExplorationEnv(SMALL)
    with pytest.raises(InputError, match="reset"):
        env.step({})
    env.reset(seed=0)
    fine = np.zeros(2, np.float32)
    with pytest.raises(InputError, match="drone_2"):
        env.step({"drone_1": fine})
    with pytest.raises(InputError, match=r"drone_2 is \(3,\)"):
        env.step({"drone_1": fine, "drone_2": np.zeros(3, np.float32)})
    with pytest.raises(InputError, match="not finite"):
        env.step({"drone_1": fine, "drone_2": np.full(2, np.nan, np.float32)})


def test_without_pettingzoo_the_message_tells_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "imagine.sim.parallel_env")
    with pytest.raises(InputError, match=r"imagine-swarm\[train\]"):
        importlib.import_module("imagine.sim.parallel_env")
