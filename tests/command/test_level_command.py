"""`imagine level` lists, shows, checks and generates, by its exit status, its JSON, its files and its pictures."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from imagine.cli import main
from imagine.sim.generator import generate_level
from imagine.sim.level import BUILT_IN, load_level
from imagine.sim.level_image import draw_level


def run(
    capsys: pytest.CaptureFixture[str], *arguments: str | Path, status: int = 0, columns: int = 160
) -> tuple[str, str]:
    """Run the command here; return what it says on standard output and standard error."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", str(columns))
        patch.setattr(sys, "argv", ["imagine", "level", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    said = capsys.readouterr()
    assert ended.value.code == status, said.err
    assert len(said.err.strip().splitlines()) == (1 if status else 0)
    return said.out, said.err


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_list_tells_the_built_in_levels(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out, _ = run(capsys, "list", "--json", tmp_path / "out.json")
    assert "furnished house" in out
    assert "house:SEED" in out
    rows = read(tmp_path / "out.json")
    assert [row["level"] for row in rows] == list(BUILT_IN)
    assert rows[4]["width_m"] == 16.0
    assert rows[4]["coverable_cells"] == load_level("4").coverable.sum()


def test_show_draws_and_measures(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = tmp_path / "four.png"
    out, _ = run(capsys, "show", "4", "--image", picture, "--json", tmp_path / "out.json")
    assert "16 × 12 m" in out
    assert Image.open(picture).size[0] >= 1000
    row = read(tmp_path / "out.json")
    assert row["fingerprint"] == load_level("4").fingerprint()
    assert row["room_for_drones"] == 16
    assert 0.7 < row["flyable_share"] < 0.9


def test_a_picture_shows_what_stands_where(tmp_path: Path) -> None:
    level = generate_level(5, people=2, crates=3)
    pixels = np.asarray(draw_level(level)).astype(int)
    low, high = level.outline.min(axis=0) - 0.5, level.outline.max(axis=0) + 0.5
    scale = min(1200 / float((high - low).max()), 120.0)
    depth = int(-(-(high - low)[1] * 2 * scale // 1)) // 2

    def colour(x: float, y: float) -> tuple[int, ...]:
        return tuple(pixels[round(depth - (y - low[1]) * scale), round((x - low[0]) * scale)])

    for box in level.polygons[-8:]:
        assert max(colour(*box.mean(axis=0))) < 150  # solids are dark
    for crate in level.crates:
        assert colour(*crate.center) == (201, 148, 74)
    for person in level.people:
        assert colour(*person.loop[0]) == (69, 117, 180)
    assert colour(*level.launch) == (26, 152, 80)
    rows, columns = np.nonzero(level.flyable)
    spots = level.launch_spots
    away = [
        spot
        for spot in spots[:: len(spots) // 50]
        if min(np.hypot(*(np.array(c.center) - spot)) for c in level.crates) > 1.0
        and np.hypot(*(np.array(level.launch) - spot)) > 1.0
    ]
    white = [colour(*spot) == (255, 255, 255) for spot in away]
    assert len(rows) == len(columns)
    assert np.mean(white) > 0.9  # but for where people walk
    assert colour(low[0] + 0.1, low[1] + 0.1) == (214, 214, 214)


def test_check_measures_what_is_good_and_ends_with_2_where_something_is_not(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out, _ = run(capsys, "check", "0", "house:3", "--json", tmp_path / "out.json")
    assert "house:3" in out
    assert [row["level"] for row in read(tmp_path / "out.json")] == ["0", "house:3"]
    shut = tmp_path / "shut.yaml"
    shut.write_text("size_m: [8, 6]\nlaunch: [1, 1]\nwalls:\n  - [[4, 0], [4, 6]]\n")
    _, err = run(capsys, "check", shut, status=2)
    assert re.match(rf"imagine: {shut}:1: 2\d\.\d+ m² around \(\d\.\d+, \d\.\d+\) can neither be reached", err)
    out, err = run(capsys, "check", "0", shut, "nope", "--json", tmp_path / "out.json", status=2)
    assert "2 of 3 levels cannot be explored, the first: " in err
    assert out.count("refused: ") == 2
    assert [sorted(row)[:1] for row in read(tmp_path / "out.json")] == [["coverable_cells"], ["error"], ["error"]]


def test_check_writes_long_names_in_full(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / ("a_long_name_of_a_folder_" * 4)
    folder.mkdir()
    names = [folder / f"floor-{number}-of-the-hall.yaml" for number in (1, 2)]
    for name, width in zip(names, (3, 4), strict=True):
        name.write_text(f"size_m: [{width}, 3]\nlaunch: [1, 1]\n")
    out, _ = run(capsys, "check", *names, columns=80)
    written = "".join(line[: line.find("  ")] if "  " in line else line for line in map(str.strip, out.splitlines()))
    assert "…" not in out
    for name in names:
        assert str(name) in written, out
    for figure in ("3 × 3", "4 × 3", "16 or more", "above 1 m"):
        assert figure in out


def test_generate_writes_a_file_that_is_the_house(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path, picture = tmp_path / "house.yaml", tmp_path / "house.png"
    run(
        capsys, "generate", "--seed", "7", "--area", "90", "-o", path, "--image", picture, "--json", tmp_path / "o.json"
    )
    level = load_level(str(path))
    assert level.fingerprint() == load_level("house:7:90").fingerprint()
    assert Image.open(picture).format == "PNG"
    (row,) = read(tmp_path / "o.json")
    assert (row["seed"], row["file"], row["fingerprint"]) == (7, str(path), level.fingerprint())


def test_generate_to_standard_output_and_to_a_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out, _ = run(capsys, "generate", "--seed", "3")
    path = tmp_path / "out.yaml"
    path.write_text(out, encoding="utf-8")
    assert load_level(str(path)).fingerprint() == generate_level(3).fingerprint()
    folder = tmp_path / "houses"
    run(capsys, "generate", "--seed", "3", "--count", "3", "--crates", "2", "-o", folder)
    assert sorted(file.name for file in folder.iterdir()) == ["house-3.yaml", "house-4.yaml", "house-5.yaml"]
    level = load_level(str(folder / "house-4.yaml"))
    assert level.fingerprint() == generate_level(4, crates=2).fingerprint()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["show", "9"], "unknown level '9'"),
        (["show", "0", "--image", "plan.jpg"], r"--image plan\.jpg: what is drawn is a PNG"),
        (["show", "0", "--image", "none/plan.png"], "folder does not exist"),
        (["check"], "NAME"),
        (["generate", "--area", "10"], "50 to 400 m²"),
        (["generate", "--seed", "-1"], "--seed"),
        (["generate", "--count", "2"], "2 levels need a folder: -o FOLDER"),
        (["generate", "--count", "2", "-o", "a.yaml"], "2 levels need a folder"),
        (["generate", "--count", "2", "-o", "x", "--image", "a.png"], "--image draws one level, not 2"),
        (["generate", "-o", "none/there/a.yaml"], "cannot be written: No such file"),
        (["list", "--json", "none/there.json"], "folder does not exist"),
    ],
)
def test_wrong_input_is_told_in_a_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    _, err = run(capsys, *arguments, status=2)
    assert re.search(said, err)
    assert list(tmp_path.iterdir()) == []
