"""Images as levels: drawn plans, and the maps of ROS map_server with their YAML."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from imagine.core.errors import InputError
from imagine.core.raster import CELL
from imagine.sim.level import Level, load_level
from imagine.sim.map_image import free_pixels, read_shades

WALL, FREE, UNKNOWN = 0, 254, 205


def plan(width: int = 120, height: int = 90) -> NDArray[np.uint8]:
    """A room of 5 × 3.5 m at 0.05 m a pixel with a pillar, walls of two pixels, and nothing known around."""
    picture = np.full((height, width), UNKNOWN, np.uint8)
    picture[8:82, 8:112] = WALL
    picture[10:80, 10:110] = FREE
    picture[30:40, 80:90] = WALL  # 30 pixels from the top
    return picture


def write(folder: Path, picture: NDArray[np.uint8], text: str | None = None, name: str = "map.png") -> str:
    Image.fromarray(picture).save(folder / name)
    if text is None:
        return f"{folder / name}@0.05"
    (folder / "map.yaml").write_text(f"image: {name}\nresolution: 0.05\n{text}")
    return str(folder / "map.yaml")


def area(level: Level) -> float:
    return float(level.coverable.sum()) * CELL * CELL


def free_at(level: Level, *points: tuple[float, float]) -> list[bool]:
    found: list[bool] = level.is_free(np.array(points, float)).tolist()
    return found


def test_an_image_with_a_scale_is_a_level(tmp_path: Path) -> None:
    level = load_level(write(tmp_path, plan()))
    assert level.name == "map"
    np.testing.assert_allclose(level.outline.min(axis=0), [0.5, 0.5])
    np.testing.assert_allclose(level.outline.max(axis=0), [5.5, 4.0])
    assert len(level.outline) == 4
    assert len(level.solids) == 1
    np.testing.assert_allclose(level.solids[0].mean(axis=0), [85 * 0.05, (90 - 35) * 0.05])  # up is up
    assert area(level) == pytest.approx(5.0 * 3.5 - 0.25, rel=0.03)
    assert level.launch == load_level(write(tmp_path, plan())).launch
    assert level.is_free(np.array([level.launch]), 1.0)[0]


def test_a_map_of_ros_is_a_level_in_its_own_frame(tmp_path: Path) -> None:
    text = "origin: [-2.0, -1.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    for name in ("map.png", "map.pgm"):
        level = load_level(write(tmp_path, plan(), text, name))
        np.testing.assert_allclose(level.outline.min(axis=0), [-1.5, -0.5])
        assert free_at(level, (0.0, 0.0), (4.25 - 2, 2.75 - 1), (-1.6, 0.0)) == [True, False, False]


def test_a_turned_origin_turns_the_map(tmp_path: Path) -> None:
    level = load_level(write(tmp_path, plan(), f"origin: [10.0, 0.0, {math.pi / 2}]\n"))
    np.testing.assert_allclose(level.outline.min(axis=0), [10 - 4.0, 0.5], atol=1e-9)
    assert free_at(level, (10 - 2.75, 4.25), (10 - 1.0, 1.0)) == [False, True]


def test_negate_makes_white_walls(tmp_path: Path) -> None:
    usual = load_level(write(tmp_path, plan(), "negate: 0\n"))
    (tmp_path / "other").mkdir()
    negated = np.where(plan() == UNKNOWN, 128, 255 - plan()).astype(np.uint8)
    level = load_level(write(tmp_path / "other", negated, "negate: 1\n"))
    assert level.fingerprint() == usual.fingerprint()


def test_thresholds_and_unknown_follow_map_server() -> None:
    shades = np.array([[0.0, 0.34, 0.36, 0.79, 0.81, 1.0, np.nan]])
    free = free_pixels(shades, False, 0.65, 0.196)
    assert free.tolist() == [[False, False, False, False, True, True, False]]
    assert free_pixels(shades, True, 0.65, 0.196).tolist() == [[True, False, False, False, False, False, False]]
    assert free_pixels(shades, False, 0.1, 0.5).tolist() == [[False, False, False, False, False, True, False]]


def test_transparent_is_unknown_and_colours_count_by_their_lightness(tmp_path: Path) -> None:
    picture = np.full((4, 4, 4), 255, np.uint8)
    picture[0, :, 3] = 0
    picture[1, :, :3] = (255, 0, 0)
    Image.fromarray(picture).save(tmp_path / "colour.png")
    shades = read_shades(tmp_path / "colour.png", "here")
    assert np.isnan(shades[0]).all()
    np.testing.assert_allclose(shades[1], 1 / 3)
    np.testing.assert_allclose(shades[2:], 1.0)


def test_only_what_hangs_together_with_the_launch_is_the_level(tmp_path: Path) -> None:
    picture = plan()
    picture[10:80, 58:62] = WALL  # two rooms without a door
    picture[40:50, :10] = FREE  # each leads out to the image's edge
    picture[40:50, 110:] = FREE
    left = load_level(write(tmp_path, picture, "launch: [1.5, 2.0]\n"))
    right = load_level(write(tmp_path, picture, "launch: [3.5, 2.0]\n"))
    assert left.outline.max(axis=0)[0] == pytest.approx(2.9)
    assert right.outline.min(axis=0)[0] == pytest.approx(3.1)
    assert left.launch == (1.5, 2.0)


def test_a_closed_room_is_refused_with_a_point_in_it(tmp_path: Path) -> None:
    picture = plan()
    picture[10:80, 68:72] = WALL  # 2.9 m and 1.9 m wide, without a door
    name = write(tmp_path, picture)
    with pytest.raises(InputError) as caught:
        load_level(name)
    said = re.fullmatch(
        rf"level {name}: (.*) m² around \((.*), (.*)\) are closed in .* the launch: fill it in, or open the wall",
        str(caught.value),
    )
    assert said is not None, caught.value
    size, x, y = map(float, said.groups())
    assert size == pytest.approx(1.9 * 3.5 - 0.25)
    assert 3.8 < x < 5.3  # well inside, and not in the pillar
    assert 0.7 < y < 3.8
    assert not (4.0 <= x <= 4.5 and 2.5 <= y <= 3.0)
    for launch, side in (("[1.5, 2.0]", r"\(4\."), ("[5.0, 2.0]", r"\(1\.")):
        with pytest.raises(InputError, match=rf"map\.yaml:1: \d+\.\d+ m² around {side}"):
            load_level(write(tmp_path, picture, f"origin: [0, 0, 0]\nlaunch: {launch}\n"))
    picture[40:60, 68:72] = FREE  # the wall opened
    assert area(load_level(write(tmp_path, picture))) > 14.0


def test_a_closed_room_is_told_in_the_frame_of_the_map(tmp_path: Path) -> None:
    picture = plan()
    picture[10:80, 68:72] = WALL
    with pytest.raises(InputError, match=r"map\.yaml:1: .* m² around \(-5\.\d+, -\d\.\d+\)"):
        load_level(write(tmp_path, picture, "origin: [-10.0, -5.0, 0.0]\nlaunch: [-8.5, -3.0]\n"))


@pytest.mark.parametrize(("side", "refused"), [(9, False), (10, True)])
def test_closed_regions_count_from_a_quarter_of_a_square_metre(tmp_path: Path, side: int, refused: bool) -> None:
    picture = plan()
    picture[50:70, 50:70] = WALL
    picture[54 : 54 + side, 54 : 54 + side] = FREE
    name = write(tmp_path, picture)
    if refused:
        with pytest.raises(InputError, match=r"0\.25 m² around \(2\.9\d, 1\.5\d\) are closed in"):
            load_level(name)
    else:
        assert len(load_level(name).solids) == 2  # the hollow one is solid


def test_outdoors_is_left_out_and_a_launch_there_leaves_out_no_room(tmp_path: Path) -> None:
    picture = plan(160, 130)
    picture[picture == UNKNOWN] = FREE
    assert area(load_level(write(tmp_path, picture))) == pytest.approx(5.0 * 3.5 - 0.25, rel=0.03)
    with pytest.raises(InputError, match=r"closed in .* or give another launch"):
        load_level(write(tmp_path, picture, "launch: [7.0, 1.0]\n"))


def test_without_launch_a_room_is_chosen_before_the_outdoors(tmp_path: Path) -> None:
    picture = plan(400, 400)
    picture[picture == UNKNOWN] = FREE
    level = load_level(write(tmp_path, picture))
    assert area(level) == pytest.approx(5.0 * 3.5 - 0.25, rel=0.03)


def test_slanted_walls_are_straightened_unless_that_is_not_wanted(tmp_path: Path) -> None:
    rows, columns = np.mgrid[:120, :120]
    picture = np.where(np.abs(columns - 60) + np.abs(rows - 60) < 50, FREE, WALL).astype(np.uint8)
    straight = load_level(write(tmp_path, picture, ""))
    stairs = load_level(write(tmp_path, picture, "simplify: false\n"))
    assert len(straight.outline) <= 12
    assert len(stairs.outline) > 150
    assert area(straight) == pytest.approx(area(stairs), rel=0.03)


def test_people_and_crates_may_be_added(tmp_path: Path) -> None:
    text = "people:\n  - {loop: [[1, 1], [3, 1]]}\ncrates:\n  - {center: [2, 3], size: [0.4, 0.4]}\n"
    level = load_level(write(tmp_path, plan(), text))
    assert (len(level.people), len(level.crates)) == (1, 1)
    with pytest.raises(InputError, match=r"map\.yaml:4: people\.0: \(9, 1\) is no place"):
        load_level(write(tmp_path, plan(), text.replace("[3, 1]", "[9, 1]")))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("resolutoin: 0.1\n", r":3: unknown key 'resolutoin'; did you mean 'resolution'"),
        ("launch: [0.2, 0.2]\n", r":3: launch \(0\.2, 0\.2\) lies on no free pixel"),
        ("launch: [99, 1]\n", r":3: launch \(99, 1\) lies on no free pixel"),
        ("launch: [0.6, 2]\n", r":3: launch \(0\.6, 2\.0\) is in or within 0\.25 m"),
        ("mode: scale\n", r":3: mode: "),
        ("free_thresh: 2\n", r":3: free_thresh: "),
        ("origin: [1]\n", r":3: "),
        ("origin: [900, 0, 0]\n", r":3: origin: a level lies within"),
        ("free_thresh: 0.0\n", r":1: no pixel is free: look at negate"),
        ("title: [1]\n", r":3: title: "),
        ("title: a\noccupied_thresh: 0.1\n", r":4: occupied_thresh: 0\.1 is below free_thresh, 0\.196: .*raise it"),
        ("free_thresh: 0.7\n", r":3: occupied_thresh: 0\.65 is below free_thresh, 0\.7: "),
    ],
)
def test_wrong_keys_are_told_by_file_and_line(tmp_path: Path, text: str, said: str) -> None:
    path = write(tmp_path, plan(), text)
    with pytest.raises(InputError, match=said) as caught:
        load_level(path)
    assert str(caught.value).startswith(path)


def test_wrong_images_are_named(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no image")
    whole = Path(write(tmp_path, plan()).partition("@")[0]).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    for name, said in (("none.png", "No such file"), ("text.png", "not an image"), ("cut.png", "cut short")):
        with pytest.raises(InputError, match=rf"level .*{name}: .*{said}"):
            load_level(f"{tmp_path / name}@0.05")
        (tmp_path / "map.yaml").write_text(f"resolution: 0.05\nimage: {name}\n")
        with pytest.raises(InputError, match=rf"map\.yaml:2: .*{name}.*{said}"):
            load_level(str(tmp_path / "map.yaml"))
    with pytest.raises(InputError, match=r"give metres a pixel behind it, such as .*map\.png@0\.05"):
        load_level(str(tmp_path / "map.png"))
    with pytest.raises(InputError, match=r"level .*map\.png@5: .* are more than 200 m: check the resolution"):
        load_level(f"{tmp_path / 'map.png'}@5")
    with pytest.raises(InputError, match="metres a pixel, above 0"):
        load_level(f"{tmp_path / 'map.png'}@0")


def test_a_part_that_only_a_crack_leads_to_is_refused_with_its_place(tmp_path: Path) -> None:
    picture = plan()
    picture[10:80, 58:62] = WALL
    picture[20:23, 58:62] = FREE  # 0.15 m wide
    with pytest.raises(InputError, match=r"map\.yaml:1: \d\.\d+ m² around \([34]\.\d+, [12]\.\d+\) can neither"):
        load_level(write(tmp_path, picture, "launch: [1.5, 2.0]\n"))
