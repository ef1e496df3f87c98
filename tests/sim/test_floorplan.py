"""Floor plans: real ones load, start where there is room, and bad ones are refused by file and coordinates."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.raster import CELL
from imagine.sim.level import load_level
from imagine.sim.level_check import hidden_regions, room_for
from imagine.sim.polygon import signed_area

DATA = Path(os.environ.get("IMAGINE_DATA", Path(__file__).resolve().parents[3] / "shared" / "data")) / "floorplans"
real = pytest.mark.skipif(not DATA.is_dir(), reason=f"no floor plans at {DATA} (set IMAGINE_DATA)")
SQUARE = [[0, 0], [4, 0], [4, 3], [0, 3]]


def write(folder: Path, data: Any) -> str:
    path = folder / "plan.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    return str(path)


@real
def test_every_real_floor_plan_can_be_explored() -> None:
    files = sorted(DATA.glob("*.json"))
    assert len(files) >= 50
    for file in files:
        level = load_level(str(file))
        assert level.name == file.stem
        area = abs(signed_area(np.array(json.loads(file.read_text())["verts"])))
        assert level.coverable.sum() * CELL * CELL == pytest.approx(area, rel=0.025, abs=0.5), file.name
        assert not hidden_regions(level)
        assert room_for(level, 3) == 3
        assert level.is_free(np.array([level.launch]), 0.5)[0]


def test_a_plan_may_be_closed_by_its_first_corner_and_starts_in_the_middle(tmp_path: Path) -> None:
    box = {"min": [0, 0], "max": [4, 3]}
    level = load_level(write(tmp_path, {"id": "a plan", "verts": [*SQUARE, SQUARE[0]], "bbox": box, "room_num": 1}))
    assert (level.name, level.title) == ("plan", "a plan")
    np.testing.assert_array_equal(level.outline, SQUARE)
    assert 1.5 <= level.launch[0] <= 2.5
    assert level.launch[1] == pytest.approx(1.5)
    again = load_level(write(tmp_path, {"verts": SQUARE}))
    assert again.launch == level.launch
    assert again.fingerprint() == level.fingerprint()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("{", r":1: not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ([1, 2], "no floor plan: expected an object with 'verts'"),
        ({"bbox": {}}, "no floor plan"),
        ({"verts": []}, "verts: expected a list"),
        ({"verts": {"x": 1}}, "verts: expected a list"),
        ({"verts": [[0, 0], [1, "x"]]}, r"verts\.1: expected \[x, y\] in metres, got \[1, 'x'\]"),
        ({"verts": [[0, 0], [1, True], [1, 1]]}, r"verts\.1: expected"),
        ('{"verts": [[0, 0], [4, 0], [NaN, 3]]}', r"verts\.2: expected"),
        ({"verts": [[0, 0], [4, 0]]}, r"verts: 2 different corners enclose nothing"),
        ({"verts": [[0, 0], [4, 4], [4, 0], [0, 4]]}, r"verts: it crosses or touches itself at \(2, 2\)"),
        ({"verts": [[0, 0], [4000, 0], [4000, 3]]}, r"verts: a level lies within .*not at \(4000, 0\)"),
        ({"verts": SQUARE, "bbox": {"min": [0, 0], "max": [400, 0.3]}}, r"corner \(4, 3\) lies outside bbox"),
        ({"verts": SQUARE, "bbox": [1]}, r"bbox: expected"),
        ({"verts": [[0, 0], [0.4, 0], [0.4, 9], [0, 9]]}, r"launch \(0\.2, \d.*\) is in or within 0\.25 m"),
        (
            {"verts": [[0, 0], [4, 0], [4, 1], [4.3, 1], [4.3, 0], [9, 0], [9, 3], [4.3, 3], [4.3, 1.3], [4, 1.3],
                       [4, 3], [0, 3]]},
            r"\d\.\d+ m² around \(\d\.\d+, \d\.\d+\) can neither be reached",
        ),
    ],
)  # fmt: skip
def test_bad_plans_are_refused_by_file_and_coordinates(tmp_path: Path, data: Any, said: str) -> None:
    path = write(tmp_path, data)
    with pytest.raises(InputError, match=said) as caught:
        load_level(path)
    assert str(caught.value).startswith(path)
    assert "\n" not in str(caught.value)


def test_a_plan_that_cannot_be_read_says_so(tmp_path: Path) -> None:
    (tmp_path / "plan.json").mkdir()
    with pytest.raises(InputError, match=r"plan\.json: cannot be read"):
        load_level(str(tmp_path / "plan.json"))
