"""A batch saved in the middle and taken up by another goes on as if nothing had happened, to the last bit."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exploration_runs import BUSY_HALL, SEED, WORLDS, act, everything, state

from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError
from imagine.sim.exploration import Exploration, Observation, Step
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import pack, unpack

KEYS = range(WORLDS)
AFTER = 150  # decisions compared
SMALL: dict[str, Any] = {"levels": ("0", "1"), "worlds": 2, "episode_ticks": 30}


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The file of a level with people and crates."""
    path = tmp_path_factory.mktemp("levels") / "hall.yaml"
    path.write_text(BUSY_HALL)
    return str(path)


def stored(saved: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """Return a state as it comes back from a checkpoint's file, and the bytes it took there."""
    file = io.BytesIO()
    torch.save(pack(saved), file)
    size = file.tell()
    file.seek(0)
    back = unpack(torch.load(file, weights_only=True))
    assert isinstance(back, dict)
    return back, size


def assert_same(one: Any, other: Any, where: str) -> None:
    if isinstance(one, dict):
        assert list(one) == list(other), where
        for name, value in one.items():
            assert_same(value, other[name], f"{name}, {where}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{k}, {where}")
    elif isinstance(one, np.ndarray | np.generic):
        one, other = np.asarray(one), np.asarray(other)
        assert (one.dtype, one.shape) == (other.dtype, other.shape), where
        if one.tobytes() != other.tobytes():
            np.testing.assert_array_equal(one, other, err_msg=where)
            pytest.fail(f"equal numbers, but not bit for bit: {where}")
    else:
        assert one == other, where


def told(env: Exploration, step: Step) -> list[dict[str, Any]]:
    """Return all that a decision brought in every world."""
    own = [{"ticks": env.ticks[world], "links": env.links()[world]} for world in range(env.worlds)]
    return [state(env, step, world) | more for world, more in enumerate(own)]


def shown(observation: Observation) -> dict[str, Any]:
    return {name: array.copy() for name, array in observation.policy.items()} | {"critic": observation.critic}


def assert_goes_on(
    make: Callable[[], Exploration], moments: Sequence[int], decisions: int, other: Exploration | None = None
) -> Exploration:
    """Fly so many decisions, saving at some; another batch, taken up from each, must bring the next ones alike."""
    env = make()
    observation, saved, brought = env.reset(), {}, []
    for decision in range(decisions):
        if decision in moments:
            saved[decision] = stored(env.state_dict())[0], shown(observation)
        step = env.step(act(env, KEYS, decision))
        observation = step.observation
        brought.append(told(env, step))
    for moment in moments:
        loaded, seen = saved[moment]
        resumed = make() if other is None else other
        assert_same(seen, shown(resumed.load_state_dict(loaded)), f"shown at {moment}")
        assert_same(seen, shown(resumed.observation()), f"shown again at {moment}")
        assert_same(loaded, stored(resumed.state_dict())[0], f"saved again at {moment}")
        for decision in range(moment, min(moment + AFTER, decisions)):
            step = resumed.step(act(resumed, KEYS, decision))
            assert_same(brought[decision], told(resumed, step), f"decision {decision} after {moment}")
    return env


def restart_moments(make: Callable[[], Exploration], decisions: int) -> list[int]:
    """Return the decisions before which some world has just been started anew, but not all of them."""
    env = make()
    env.reset()
    moments = []
    for decision in range(decisions):
        if 0 < env.step(act(env, KEYS, decision)).done.sum() < WORLDS:
            moments.append(decision + 1)
    return moments


@pytest.mark.parametrize(
    ("changes", "decisions"),
    [
        ({"stagger": True}, 430),
        ({"action": ActionSpec(mode="waypoint", decision_ticks=4), "protocol": "one-hop"}, 200),
    ],
    ids=["every tick", "decisions of four ticks"],
)
def test_it_goes_on_bit_for_bit(hall: str, changes: dict[str, Any], decisions: int) -> None:
    settings = everything(hall, **changes)

    def make() -> Exploration:
        return Exploration(settings, SEED)

    just_begun = restart_moments(make, decisions - 20)
    moments = sorted({0, 1, just_begun[0], just_begun[-1], decisions // 2, decisions - 20})
    env = assert_goes_on(make, moments, decisions)
    assert env.twin.episodes.min() >= 4  # what the constructor showed, and three episodes
    assert env.air.state.links["lost"].sum() > 0
    assert {level.name for level in env.twin.levels} != {"1"}


def test_a_batch_that_flew_something_else_takes_a_state_up_as_well(hall: str) -> None:
    settings = everything(hall)
    other = Exploration(settings, SEED)
    other.reset()
    for decision in range(37):
        other.step(-act(other, KEYS, decision))
    assert_goes_on(lambda: Exploration(settings, SEED), [3, 140], 260, other)


def test_worlds_that_ended_and_were_not_begun_anew_stay_ended(hall: str) -> None:
    settings = everything(hall, episode_ticks=90, stagger=True, action=ActionSpec(mode="body", decision_ticks=4))
    env = assert_goes_on(lambda: Exploration(settings, SEED, restart=False), [2, 15, 20, 30], 40)
    assert env.step(np.zeros((WORLDS, 3, 3), np.float32)).done.all()


def test_weights_that_were_set_hold_after_it_too() -> None:
    env, resumed = (Exploration(ExplorationSettings(**SMALL), 4) for _ in range(2))
    env.reset()
    env.set_level_weights([0.0, 1.0])
    resumed.load_state_dict(stored(env.state_dict())[0])
    np.testing.assert_array_equal(resumed.level_weights, [0.0, 1.0])
    for one in (env, resumed):
        one.reset()
        assert {level.name for level in one.twin.levels} == {"1"}


def test_a_state_from_before_the_first_reset_starts_the_same_episodes() -> None:
    env, fresh, flown = (Exploration(ExplorationSettings(**SMALL), 4) for _ in range(3))
    saved = stored(env.state_dict())[0]
    flown.reset()
    flown.reset()
    for other in (fresh, flown):
        other.load_state_dict(saved)
    assert_same(saved, stored(fresh.state_dict())[0], "saved again")
    first = shown(env.reset())
    for other in (fresh, flown):
        assert_same(first, shown(other.reset()), "shown")
        assert_same(env.state_dict(), other.state_dict(), "saved after it")


def test_a_state_is_the_callers_own_and_small() -> None:
    settings = ExplorationSettings(**SMALL | {"episode_ticks": 1000, "stop_coverage": 1.0})
    env = Exploration(settings, 0)
    env.reset()
    rng = np.random.default_rng(0)
    before = env.state_dict()
    kept = stored(before)[0]
    for _ in range(300):
        env.step(rng.uniform(-1.0, 1.0, (2, 3, 2)))
    assert_same(kept, stored(before)[0], "kept")
    _, size = stored(env.state_dict())
    assert env.ticks.tolist() == [300, 300]
    assert size - stored(before)[1] == pytest.approx(300 * 2 * 3 * 2 * 4, abs=1000)


@pytest.mark.parametrize(
    ("changes", "seed", "said"),
    [
        ({"worlds": 3}, 0, "worlds was 2, is 3"),
        ({"drones": 2}, 0, "drones was 3, is 2"),
        ({"levels": ("0", "2")}, 0, r"levels was \['0', '1'\], is \['0', '2'\]"),
        ({"action": ActionSpec(mode="body")}, 0, "action.mode was plane, is body"),
        ({"episode_ticks": 31, "stagger": True}, 0, "episode_ticks was 30, is 31; stagger was False, is True"),
        ({}, 1, "seed was 0, is 1"),
    ],
)
def test_another_environments_state_is_refused_by_what_differs(changes: dict[str, Any], seed: int, said: str) -> None:
    env, other = Exploration(ExplorationSettings(**SMALL), 0), Exploration(ExplorationSettings(**SMALL | changes), seed)
    env.reset()
    before = shown(other.reset())
    with pytest.raises(InputError, match=f"environment state: of another environment: .*{said}"):
        other.load_state_dict(env.state_dict())
    assert_same(before, shown(other.observation()), "untouched")


def test_a_level_whose_file_has_changed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hall.yaml"
    path.write_text(BUSY_HALL)
    settings = ExplorationSettings(levels=(str(path),), worlds=1)
    saved = Exploration(settings, 0).state_dict()
    path.write_text(BUSY_HALL.replace("radius: 0.35", "radius: 0.4"))
    with pytest.raises(InputError, match="fingerprints"):
        Exploration(settings, 0).load_state_dict(saved)


def test_what_is_no_state_of_this_version_is_refused() -> None:
    env = Exploration(ExplorationSettings(**SMALL), 0)
    for wrong in ({"generators": [], "episodes": []}, None, {}):
        with pytest.raises(InputError, match="environment state: not of this version"):
            env.load_state_dict(wrong)  # type: ignore[arg-type]


def test_a_world_that_comes_out_elsewhere_starts_anew_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    env, resumed = (Exploration(ExplorationSettings(**SMALL), 4) for _ in range(2))
    env.reset()
    for _ in range(12):
        env.step(np.full((2, 3, 2), 0.5))
    saved = env.state_dict()
    saved["poses"][1, 0, 0] += 1e-12  # as if another processor had rounded otherwise
    with caplog.at_level(logging.WARNING):
        observation = resumed.load_state_dict(saved)
    assert "worlds 1 did not come out as they were saved" in caplog.text
    assert resumed.ticks.tolist() == [12, 0]
    assert_same(env.observation().policy["views"][0], observation.policy["views"][0], "world 0")
    step = resumed.step(np.zeros((2, 3, 2)))
    assert np.isfinite(step.observation.policy["views"]).all()
    assert resumed.ticks.tolist() == [13, 1]
