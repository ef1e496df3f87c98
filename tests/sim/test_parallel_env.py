"""The PettingZoo face of exploration: it keeps to the API, and to the world behind it."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="PettingZoo is not installed: it comes with the extra 'train'")

from pettingzoo.test import parallel_api_test, parallel_seed_test

from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.parallel_env import ExplorationEnv
from imagine.sim.render import DRONES, frame_of

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


@pytest.mark.filterwarnings("error")
def test_it_passes_pettingzoos_own_seed_test() -> None:
    parallel_seed_test(lambda: ExplorationEnv(SMALL), num_cycles=20)


@pytest.mark.parametrize(
    "spec",
    [
        ObservationSpec(view_cells=8, view_scales_m=(0.2,), frontier_ranges_m=(2.0,), lidar_sectors=7),
        ObservationSpec(
            view_cells=10, view_scales_m=(0.1, 0.2, 0.4, 0.8), frontier_ranges_m=(1.0,) * 4, axes="heading"
        ),
    ],
    ids=["one scale", "four scales"],
)
@pytest.mark.parametrize("mode", ["plane", "body"])
def test_spaces_follow_the_specifications(spec: ObservationSpec, mode: str) -> None:
    env = ExplorationEnv(SMALL.model_copy(update={"observation": spec, "action": ActionSpec(mode=mode)}))
    observations, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        for agent, seen in observations.items():
            assert {name: array.shape for name, array in seen.items()} == spec.shapes
            assert env.observation_space(agent).contains(seen)
            assert env.action_space(agent).shape == (ActionSpec(mode=mode).size,)
        observations = env.step(random_actions(env, rng))[0]


def fall(env: ExplorationEnv, drone: int) -> None:
    """Let a drone fall, as a touch does where touching kills."""
    env._exploration.alive[0, drone] = False


def test_who_falls_terminates_alone_and_is_no_agent_from_then_on() -> None:
    env = ExplorationEnv(SMALL)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    env.step(random_actions(env, rng))
    fall(env, 0)
    observations, rewards, terminations, truncations, infos = env.step(random_actions(env, rng))
    assert list(observations) == list(rewards) == list(infos) == ["drone_1", "drone_2"]
    assert terminations == {"drone_1": True, "drone_2": False}
    assert not any(truncations.values())
    assert [info["alive"] for info in infos.values()] == [False, True]
    assert env.agents == ["drone_2"]
    acting = random_actions(env, rng)
    assert list(acting) == ["drone_2"]
    before = env._exploration.twin.poses[0].copy()
    for _ in range(3):
        told = env.step({"drone_2": np.array([0.0, 1.0], np.float32)})
        assert all(list(part) == ["drone_2"] for part in told)
    assert env._exploration.twin.poses[0, 1, 1] > before[1, 1] + 0.05  # the action went to the right drone
    assert env.state().shape == (2, 5, 32, 32)
    fall(env, 1)
    _, _, terminations, _, _ = env.step({"drone_2": np.zeros(2, np.float32)})
    assert terminations == {"drone_2": True}
    assert env.agents == []
    observations, _ = env.reset(seed=0)
    assert list(observations) == env.agents == ["drone_1", "drone_2"]


def test_who_falls_in_the_last_tick_was_not_cut_short() -> None:
    env = ExplorationEnv(SMALL.model_copy(update={"episode_ticks": 2, "stop_coverage": 1.0}))
    env.reset(seed=0)
    zero = {agent: np.zeros(2, np.float32) for agent in env.agents}
    env.step(zero)
    fall(env, 1)
    _, _, terminations, truncations, _ = env.step(zero)
    assert terminations == {"drone_1": False, "drone_2": True}
    assert truncations == {"drone_1": True, "drone_2": False}
    assert env.agents == []


def test_it_draws_itself_where_wanted() -> None:
    env = ExplorationEnv(SMALL, render_mode="rgb_array", render_px=400)
    assert "rgb_array" in env.metadata["render_modes"]
    assert env.metadata["render_fps"] == 10
    with pytest.raises(InputError, match="reset"):
        env.render()
    env.reset(seed=0)
    first = env.render()
    for _ in range(8):
        env.step(dict.fromkeys(env.agents, np.array([0.0, 1.0], np.float32)))
    picture = env.render()
    assert picture is not None
    assert picture.dtype == np.uint8
    assert picture.shape == first.shape == env.render().shape
    assert (picture != first).any()
    frame = frame_of(env._exploration.twin.levels[0], 400)
    poses = env._exploration.twin.poses[0]
    for drone in range(2):  # the disc of each, beside its number
        row, column = frame.pixel(poses[drone, 0], poses[drone, 1])
        assert (picture[row - 5 : row + 6, column - 5 : column + 6] == DRONES[drone]).all(axis=-1).any()
    env.close()


def test_without_a_render_mode_it_draws_nothing_and_says_so() -> None:
    env = ExplorationEnv(SMALL)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="rgb_array"):
        assert env.render() is None
    with pytest.raises(InputError, match="human"):
        ExplorationEnv(SMALL, render_mode="human")  # type: ignore[arg-type]


def test_the_seed_decides_everything() -> None:
    env = ExplorationEnv(SMALL, seed=3)
    first, second = fly(env, seed=3), fly(env, seed=3)
    assert flat(first) == flat(second) == flat(fly(ExplorationEnv(SMALL), seed=3))
    assert flat(fly(ExplorationEnv(SMALL, seed=3), seed=None)) == flat(first)
    assert flat(fly(env, seed=4)) != flat(first)


def test_what_was_told_stays_as_it_was_told() -> None:
    """Learners keep observations for later, and the batch behind writes into arrays of its own."""
    env, rng = ExplorationEnv(SMALL), np.random.default_rng(5)
    kept: list[Any] = [env.reset(seed=3)]
    then = [flat(kept[0])]
    for _ in range(5):
        kept.append(env.step(random_actions(env, rng)))
        then.append(flat(kept[-1]))
    env.reset()
    assert [flat(told) for told in kept] == then


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
    with pytest.raises(InputError, match="the action of drone_2: not numbers"):
        env.step({"drone_1": fine, "drone_2": ["left", "right"]})  # type: ignore[dict-item]
    with pytest.raises(InputError, match="not finite"):
        env.step({"drone_1": fine, "drone_2": np.full(2, np.nan, np.float32)})


def test_without_pettingzoo_the_message_tells_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "imagine.sim.parallel_env")
    with pytest.raises(InputError, match=r"imagine-swarm\[train\]"):
        importlib.import_module("imagine.sim.parallel_env")


def test_a_negative_seed_is_refused_and_the_episode_goes_on() -> None:
    env = ExplorationEnv(SMALL)
    env.reset(seed=0)
    with pytest.raises(InputError, match="seed is -7"):
        env.reset(seed=-7)
    _, _, _, _, infos = env.step(dict.fromkeys(env.agents, np.zeros(2, np.float32)))
    assert infos["drone_1"]["ticks"] == 1
