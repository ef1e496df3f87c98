"""Ranges of levels: what they stand for, how they share a weight, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from imagine.core.errors import InputError
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.generator import AREA_M2
from imagine.sim.level import load_level
from imagine.sim.level_names import expand_level, expand_levels, house_area, level_family, reported_name


@pytest.mark.parametrize(
    ("name", "levels"),
    [
        ("4", ("4",)),
        ("rooms.yaml", ("rooms.yaml",)),
        ("plan-2.png@0.05", ("plan-2.png@0.05",)),
        ("0-2", ("0", "1", "2")),
        ("house:7", ("house:7",)),
        ("house:7:120", ("house:7:120",)),
        ("house:3-5", ("house:3", "house:4", "house:5")),
        ("house:3-4:80.5", ("house:3:80.5", "house:4:80.5")),
        ("house:0-2:50-200", ("house:0:50", "house:1:142.7", "house:2:85.4")),
        ("house:2:50-200", ("house:2:85.4",)),
    ],
)
def test_a_range_stands_for_its_levels(name: str, levels: tuple[str, ...]) -> None:
    assert expand_level(name) == levels


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("6-0", "levels 6-0: the range is empty; write 0-6"),
        ("house:9-3:50-80", "levels house:9-3:50-80: the range is empty; write house:3-9:50-80"),
        ("house:0-1000", "more than 1000 levels"),
        ("house:0-9:40-200", "the areas 40-200 m² are not within 50 to 400, smallest first"),
        ("house:0-9:50-500", "the areas 50-500 m² are not within 50 to 400, smallest first"),
        ("house:0-9:200-50", "the areas 200-50 m² are not within 50 to 400, smallest first"),
        ("house:-3", "expected house:SEED or house:FIRST-LAST"),
        ("house:a-b:50-80", "expected house:SEED or house:FIRST-LAST"),
        ("house:0-9:50-", "an area or a range of areas"),
        (f"house:{2**63}-{2**63}", "numbers go to"),
    ],
)
def test_a_wrong_range_is_refused_by_name(name: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        expand_level(name)
    assert message in str(error.value)


def test_a_training_configuration_refuses_a_wrong_range_at_its_key() -> None:
    with pytest.raises(ValidationError, match="the range is empty; write house:3-9"):
        ExplorationSettings(levels=("4", "house:9-3"))


@given(st.integers(0, 2**62), st.integers(1, 40), st.floats(50.0, 390.0), st.floats(1.0, 300.0))
def test_areas_are_spread_evenly_and_depend_on_the_seed_alone(first: int, count: int, low: float, width: float) -> None:
    low, high = round(low, 1), round(min(low + width, AREA_M2[1]), 1)
    names = expand_level(f"house:{first}-{first + count - 1}:{low}-{high}")
    areas = np.array([float(name.rsplit(":", 1)[1]) for name in names])
    assert names[0] == expand_level(f"house:{first}:{low}-{high}")[0]
    assert areas.tolist() == [house_area(first + k, (low, high)) for k in range(count)]
    assert (areas >= low).all()
    assert (areas <= high).all()
    # three distances of a golden sequence (Swierczkowski 1958): none is wider than phi^2 over the count
    gaps = np.diff(np.sort([low, *areas, high]))
    assert gaps.max() <= 2.62 * (high - low) / count + 0.11


@given(
    st.lists(st.tuples(st.sampled_from(["4", "0-2", "house:1-7", "house:5:60-90"]), st.floats(0.0, 9.0)), min_size=1)
)
def test_a_range_shares_its_weight(entries: list[tuple[str, float]]) -> None:
    names, weights = zip(*entries, strict=True)
    if sum(weights) == 0.0:
        with pytest.raises(InputError, match="level_weights"):
            expand_levels(names, weights)
        return
    levels, shares = expand_levels(names, weights)
    assert sum(shares) == pytest.approx(1.0)
    at = 0
    for name, weight in entries:
        own = expand_level(name)
        assert levels[at : at + len(own)] == own
        assert shares[at : at + len(own)] == pytest.approx([weight / sum(weights) / len(own)] * len(own))
        at += len(own)
    assert at == len(levels)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 10_000))
def test_houses_of_a_range_are_as_large_as_named(first: int) -> None:
    for name in expand_level(f"house:{first}-{first + 1}:50-200"):
        level = load_level(name)
        assert level.name == name == reported_name(name)
        assert f"{float(name.rsplit(':', 1)[1]):g} m²" in level.title


def test_files_are_reported_by_their_stem(tmp_path: Path) -> None:
    plan = tmp_path / "a.plan.json"
    plan.write_text(json.dumps({"verts": [[0, 0], [4, 0], [4, 3], [0, 3]]}))
    assert load_level(str(plan)).name == reported_name(str(plan)) == "a.plan"
    rooms = tmp_path / "rooms@home.yaml"
    rooms.write_text("size_m: [4, 3]\nlaunch: [1, 1]\n")
    assert load_level(str(rooms)).name == reported_name(str(rooms)) == "rooms@home"
    assert reported_name("plans/first.png@0.05") == "first"
    assert load_level("4").name == reported_name("4") == "4"
    assert level_family("house:3:80") == "houses"
    assert level_family("4") == "4"


def test_a_batch_explores_the_houses_of_a_range() -> None:
    chosen = ExplorationSettings(
        levels=("0", "house:0-39:50-60"), level_weights=(1.0, 3.0), worlds=32, drones=1, mirror=False
    )
    env = Exploration(chosen, seed=3)
    env.reset()
    shown = [level.name for level in env.twin.levels]
    assert 2 <= shown.count("0") <= 16  # a quarter of the draws
    assert len(set(shown)) > 12
    assert set(shown) <= {"0", *expand_level("house:0-39:50-60")}
