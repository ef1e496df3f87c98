"""What prevents exploring a level is told when it is loaded: file, line, and coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.raster import CELL
from imagine.sim.level import load_level

ROOM = "size_m: [8, 6]\nlaunch: [1, 1]\n"
PEOPLE = ROOM + "boxes:\n  - {center: [4, 3], size: [1, 1]}\npeople:\n"


DOCS = Path(__file__).resolve().parents[2] / "docs" / "levels.md"


def test_the_example_of_the_documentation_is_a_level(tmp_path: Path) -> None:
    example = DOCS.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]
    level = load_level(write(tmp_path, example))
    assert (len(level.solids), len(level.people), len(level.crates), len(level.circles)) == (1, 1, 1, 1)
    assert level.coverable.sum() * CELL * CELL == pytest.approx(46.0, abs=1.0)


def write(folder: Path, text: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("outline: [[0, 0], [4, 4], [4, 0], [0, 4]]\nlaunch: [1, 2]\n", r":1: outline: it crosses .* at \(2, 2\)"),
        ("outline: [[0, 0], [2, 2], [4, 4]]\nlaunch: [1, 2]\n", r":1: outline: it encloses no area: an open line"),
        ("launch: [1, 2]\noutline: [[0, 0], [4, 0], [4, 0], [4, 4]]\n",
         r":2: outline: corner 1 at \(4, 0\) comes again"),
        ("launch: [1, 1]\noutline: [[0, 0], [4, 4], [0, 0]]\n", r":2: outline: 2 different corners"),
        (ROOM + "solids:\n  - [[3, 3], [4, 3], [4, 4]]\n  - [[5, 1], [7, 3], [7, 1], [5, 3]]\n",
         r":5: solids\.1: it crosses .* at \(6, 2\)"),
        (ROOM + "solids:\n  - [[5, 1], [7, 3]]\n", r":4: solids\.0: 2 different corners enclose nothing"),
        (ROOM + "solids:\n  - [[5, 1], [7, 3], [500, 3]]\n", r":4: solids\.0: a level lies within .* \(500, 3\)"),
        (ROOM + "walls:\n  - [[4, 0], [4, 6]]\n", r":1: 2[34]\.\d+ m² around \([56]\.\d+, [23]\.\d+\) can neither be"),
        (ROOM + "walls:\n  - [[5, 6], [5, 4], [8, 4]]\n", r":1: [56]\.\d+ m² around \(6\.\d+, [45]\.\d+\) can neither"),
        (ROOM + "boxes:\n  - {center: [1.2, 1], size: [0.1, 0.1]}\n", r":2: launch \(1.0, 1.0\) is in or within"),
        (ROOM + "crates:\n  - {center: [8, 3], size: [1, 1]}\n",
         r":4: crates\.0: \(8\.\d+, \d\.\d+\) of the crate lies"),
        (ROOM + "crates:\n  - {center: [2, 3], size: [1, 1]}\n  - {center: [99, 3], size: [1, 1]}\n",
         r":5: crates\.1: \(99"),
        (PEOPLE + "  - {loop: [[1, 3], [4, 3]]}\n", r":6: people\.0: \(4, 3\) is no place to walk to"),
        (PEOPLE + "  - {loop: [[1, 3], [7, 3]]}\n", r":6: people\.0: .* on the way from \(1, 3\) to \(7, 3\)"),
        (PEOPLE + "  - {loop: [[1, 3], [1, 5], [7, 3]]}\n", r":6: people\.0: .* on the way from \(7, 3\) to \(1, 3\)"),
        (PEOPLE + "  - {loop: [[1, 3], [-5, 3]]}\n", r":6: people\.0: \(-5, 3\) is no place"),
        ("size_m: [1.2, 1.2]\nlaunch: [0.6, 0.6]\npeople:\n  - {loop: [[0.6, 0.6], [0.6, 0.8]], radius: 0.5}\n",
         r":2: no room for a drone around launch \(0\.6, 0\.6\)"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_by_line_and_coordinates(tmp_path: Path, text: str, said: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=said) as caught:
        load_level(path)
    assert str(caught.value).startswith(path)
    assert "\n" not in str(caught.value)


def test_posts_block_a_way_too(tmp_path: Path) -> None:
    text = ROOM + "circles:\n  - {center: [4, 3], radius: 0.3}\npeople:\n  - {loop: [[1, 3.2], [7, 3.2]]}\n"
    with pytest.raises(InputError, match=r"on the way from \(1, 3\.2\)"):
        load_level(write(tmp_path, text))
    load_level(write(tmp_path, text.replace("3.2]", "3.4]")))


def test_a_sliver_that_nobody_sees_is_ignored(tmp_path: Path) -> None:
    text = ROOM + "walls:\n  - [[7.52, 6], [7.52, 5.52], [8, 5.52]]\n"  # closes off 0.43 by 0.43 m
    level = load_level(write(tmp_path, text))
    assert 0 < (level.free & ~level.coverable).sum() * CELL * CELL < 0.25


def test_solids_of_any_shape_are_solid(tmp_path: Path) -> None:
    horseshoe = "[[3, 1], [6, 1], [6, 2], [4, 2], [4, 4], [6, 4], [6, 5], [3, 5], [3, 1]]"
    level = load_level(write(tmp_path, ROOM + f"solids:\n  - {horseshoe}\n"))
    assert level.is_free(np.array([[3.5, 3.0], [5.0, 3.0], [5.0, 1.5]])).tolist() == [False, True, False]
    assert len(level.solids[0]) == 8
    assert level.coverable.sum() * CELL * CELL == pytest.approx(48 - 12 + 4, rel=0.02)


def test_crates_and_people_keep_drones_from_starting_on_them(tmp_path: Path) -> None:
    bare = load_level(write(tmp_path, ROOM))
    movers = "crates:\n  - {center: [1, 1], size: [0.6, 0.4], yaw_deg: 30}\npeople:\n  - {loop: [[3, 1], [3, 4]]}\n"
    level = load_level(write(tmp_path, ROOM + movers))
    assert (level.flyable == bare.flyable).all()
    assert (bare.coverable.sum() - level.coverable.sum()) * CELL * CELL == pytest.approx(0.24, abs=0.06)
    poses = np.array(level.launch_poses(8))[:, :2]
    assert np.hypot(*(poses - (3, 1)).T).min() > 0.25 + 0.25
    corners = level.crates[0].corners()
    assert np.hypot(*(poses[:, None] - corners[None]).transpose(2, 0, 1)).min() > 0.25
    assert np.hypot(*(poses - (1, 1)).T).min() > 0.2 + 0.25


@pytest.mark.parametrize(
    "name",
    [
        "plan.png", "house:", "house:x", "house:-1", "house:7:", "house:7:big", "house:7:20", "house:7:nan",
        "house:99999999999999999999", "plan.png@", "plan.png@-1", "plan.png@x",
    ],
)  # fmt: skip
def test_names_that_are_nearly_right_are_told_what_is_missing(name: str) -> None:
    with pytest.raises(InputError, match=rf"level {name}: |level plan.png.*metres a pixel|level {name}.*m²"):
        load_level(name)
