"""What `imagine evaluate --levels` takes: names, ranges, and ranges of generated houses."""

from __future__ import annotations

import pytest

pytest.importorskip("torch", reason="the train extra is not installed")

from imagine.core.errors import InputError
from imagine.evaluate_command import level_list


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
