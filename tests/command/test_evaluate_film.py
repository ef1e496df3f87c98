"""`imagine evaluate --film` leaves a film, or says beforehand why it cannot."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import environment, run_imagine
from PIL import Image

pytest.importorskip("torch", reason="the train extra is not installed")

COMMAND = ["evaluate", "--policy", "frontier", "--levels", "0", "--drones", "2", "--episodes", "2"]


def test_the_first_episode_is_filmed_beside_the_table(tmp_path: Path) -> None:
    film, table = tmp_path / "film.gif", tmp_path / "table.json"
    done = run_imagine(*COMMAND, "--film", film, "--json", table, env=environment(COLUMNS="80"))
    assert done.returncode == 0, done.stderr
    assert "film.gif: " in done.stderr
    (row,) = json.loads(table.read_text())
    with Image.open(film) as gif:
        assert 2 <= gif.n_frames <= 201
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.gif", "table.json"]
    assert "…" not in done.stdout  # every column fits into 80
    assert "contacts" in done.stdout
    assert row["coverage_mean"] > 0.9


@pytest.mark.parametrize(
    ("name", "said"),
    [("film.avi", r".gif or .mp4"), ("no/film.gif", "folder does not exist"), ("", "films are GIF or MP4")],
    ids=["suffix", "folder", "a folder itself"],
)
def test_a_film_that_cannot_be_written_is_refused_before_flying(tmp_path: Path, name: str, said: str) -> None:
    done = run_imagine(*COMMAND, "--film", tmp_path / name)
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("imagine: ")
    assert said in line
    assert list(tmp_path.iterdir()) == []
