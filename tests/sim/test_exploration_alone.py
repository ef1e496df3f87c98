"""The second promise of the twin: a run depends on nothing but its seed, and a world on nothing but seed and key."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import exploration_runs
import numpy as np
import pytest
from exploration_runs import BUSY_HALL, SEED, WORLDS, everything, fly, run_hash, state

from imagine.core.contract import ActionSpec
from imagine.sim.exploration import Exploration

STEPS = 400


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The file of a level with people and crates."""
    path = tmp_path_factory.mktemp("levels") / "hall.yaml"
    path.write_text(BUSY_HALL)
    return str(path)


def assert_same(one: Any, other: Any, where: str) -> None:
    if isinstance(one, dict):
        assert list(one) == list(other)
        for name, value in one.items():
            assert_same(value, other[name], f"{name}, {where}")
    elif isinstance(one, list):
        assert len(one) == len(other), where
        for a, b in zip(one, other, strict=True):
            assert_same(a, b, where)
    else:
        assert np.asarray(one).dtype == np.asarray(other).dtype, where
        if np.asarray(one).dtype.kind == "V":
            assert one.tobytes() == other.tobytes(), where
        else:
            np.testing.assert_array_equal(one, other, err_msg=where)


@pytest.mark.parametrize(
    ("changes", "steps"),
    [
        ({}, STEPS),
        ({"action": ActionSpec(mode="waypoint", decision_ticks=4), "protocol": "one-hop"}, STEPS // 4),
    ],
    ids=["every tick", "decisions of four ticks"],
)
def test_a_world_in_a_batch_is_bit_for_bit_the_world_alone(hall: str, changes: dict[str, Any], steps: int) -> None:
    settings = everything(hall, **changes)
    batch = Exploration(settings, SEED)
    singles = [
        Exploration(settings.model_copy(update={"worlds": 1}), SEED, world_keys=[world]) for world in range(WORLDS)
    ]
    flights = [fly(single, [world], steps) for world, single in enumerate(singles)]
    levels, ends, fallen = set(), np.zeros(WORLDS, int), 0
    for tick, together in enumerate(fly(batch, range(WORLDS), steps)):
        for world, (single, flight) in enumerate(zip(singles, flights, strict=True)):
            alone = next(flight)
            where = f"world {world}, step {tick}"
            assert_same(state(single, alone, 0), state(batch, together, world), where)
        levels |= {level.name for level in batch.twin.levels}
        ends += together.done
        fallen += int((~batch.alive).sum())
    assert len(levels) >= 4
    assert (ends >= 2).all()
    assert fallen > 0
    assert batch.air.state.links["lost"].sum() > 0


def test_keys_and_not_places_name_the_worlds(hall: str) -> None:
    settings = everything(hall, worlds=3)
    forth, back = Exploration(settings, SEED, world_keys=[7, 2, 9]), Exploration(settings, SEED, world_keys=[9, 7, 2])
    for one, other in zip(fly(forth, [7, 2, 9], 60), fly(back, [9, 7, 2], 60), strict=True):
        for here, there in ((0, 1), (1, 2), (2, 0)):
            assert_same(state(forth, one, here), state(back, other, there), f"world {here}")
    assert not np.array_equal(forth.twin.poses[0], forth.twin.poses[1])


def test_a_run_repeats_itself_with_any_number_of_threads(hall: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first, _ = run_hash(hall, 150)
    again, threads = run_hash(hall, 150)
    assert again == first
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(threads + 2))
    assert run_hash(hall, 150) == (first, threads + 2)


def test_a_run_repeats_itself_in_another_process_on_one_core(hall: str) -> None:
    script = Path(exploration_runs.__file__)
    told = subprocess.run(
        [sys.executable, str(script), hall, "1", "150"], check=True, capture_output=True, text=True, timeout=300
    )
    assert told.stdout.split() == [run_hash(hall, 150)[0], "1"]


def test_another_seed_is_another_run(hall: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first, _ = run_hash(hall, 3)
    monkeypatch.setattr(exploration_runs, "SEED", SEED + 1)
    assert run_hash(hall, 3)[0] != first
