"""What `imagine evaluate --levels` takes: names, ranges, and ranges of generated houses."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="the train extra is not installed")

from imagine.core.errors import InputError
from imagine.evaluate_lists import level_list, policy_list, protocol_list, team_sizes, within_area

PLANS = Path(os.environ.get("IMAGINE_DATA", Path(__file__).resolve().parents[3] / "shared" / "data")) / "floorplans"


@pytest.mark.parametrize(
    ("text", "levels"),
    [
        ("4", ["4"]),
        ("0-6", ["0", "1", "2", "3", "4", "5", "6"]),
        ("1, 3,my-house.yaml", ["1", "3", "my-house.yaml"]),
        ("house:0-9", [f"house:{seed}" for seed in range(10)]),
        ("house:8-10:120,2", ["house:8:120", "house:9:120", "house:10:120", "2"]),
        ("house:7", ["house:7"]),
        ("house:7:90", ["house:7:90"]),
        ("plan-2.png@0.05", ["plan-2.png@0.05"]),
        ("4,3-5,4", ["4", "3", "5"]),
    ],
)
def test_lists_and_ranges(text: str, levels: list[str]) -> None:
    assert level_list(text) == levels


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("6-0", "--levels 6-0: the range is empty; write 0-6"),
        ("1,house:9-3:80", "--levels house:9-3:80: the range is empty; write house:3-9:80"),
        ("house:0-5000", "more than 1000 levels"),
        ("", "--levels '': a level is missing"),
        ("1,,2", "--levels '1,,2': a level is missing"),
    ],
)
def test_ranges_that_are_none(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        level_list(text)


def square(folder: Path, name: str, side_m: float) -> str:
    path = folder / name
    path.write_text(json.dumps({"verts": [[0, 0], [side_m, 0], [side_m, side_m], [0, side_m]]}))
    return str(path)


def test_a_folder_and_a_pattern_stand_for_the_files_in_them(tmp_path: Path) -> None:
    b, a = square(tmp_path, "b.json", 4), square(tmp_path, "a.json", 4)
    (tmp_path / "notes.txt").write_text("no level")
    assert level_list(str(tmp_path)) == [a, b]
    assert level_list(f"0,{tmp_path}/b*.json,{tmp_path}") == ["0", b, a]


def test_a_folder_or_pattern_without_levels_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no level")
    with pytest.raises(InputError, match="the folder holds no levels"):
        level_list(str(tmp_path))
    with pytest.raises(InputError, match="no file fits this pattern"):
        level_list(f"{tmp_path}/*.json")


def test_levels_up_to_an_area_are_kept(tmp_path: Path) -> None:
    small, large = square(tmp_path, "small.json", 5), square(tmp_path, "large.json", 12)
    assert within_area([large, small], 26.0) == [small]
    assert within_area([large, small], None) == [large, small]
    with pytest.raises(InputError, match=r"--max-area 9: all levels are larger; the smallest has 25 m²"):
        within_area([large, small], 9.0)


@pytest.mark.skipif(not PLANS.is_dir(), reason=f"no floor plans at {PLANS} (set IMAGINE_DATA)")
def test_real_plans_up_to_200_square_metres() -> None:
    plans = level_list(str(PLANS))
    assert (len(plans), len(within_area(plans, 200.0))) == (50, 41)


def test_lists_of_teams_protocols_and_policies(tmp_path: Path) -> None:
    assert team_sizes("3,1,3") == [3, 1]
    assert protocol_list("off, multi-hop,off") == ["off", "multi-hop"]
    odd = tmp_path / "a,b.onnx"
    odd.touch()
    assert policy_list(["frontier,random", str(odd)]) == ["frontier", "random", str(odd)]
    with pytest.raises(InputError, match="--protocol two-hop"):
        protocol_list("off,two-hop")
    with pytest.raises(InputError, match="a policy is missing"):
        policy_list(["frontier,"])
