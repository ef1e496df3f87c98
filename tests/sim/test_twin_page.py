"""The examples of docs/twin.md run as they stand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from imagine.sim.metrics import EpisodeMetrics

PAGE = Path(__file__).resolve().parents[2] / "docs" / "twin.md"


def example(word: str) -> str:
    """Return the one python block of the page that holds `word`."""
    (block,) = (b for b in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL) if word in b)
    return str(block)


def run(code: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(compile(code, PAGE.name, "exec"), names)
    return names


def test_the_vector_example_flies_whole_episodes(capsys: pytest.CaptureFixture[str]) -> None:
    names = run(example("for episode in step.episodes"))
    told = capsys.readouterr().out.splitlines()
    assert len(told) >= 8
    assert {line.split()[0] for line in told} == {"1", "2"}
    shapes = {name: list(array.shape) for name, array in names["observation"].items()}
    assert str(shapes).replace("'", '"') in example("for episode in step.episodes")


def test_the_pettingzoo_example_flies_an_episode(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pettingzoo", reason="PettingZoo is not installed: it comes with the extra 'train'")
    names = run(example("ExplorationEnv("))
    assert names["env"].agents == []
    assert names["picture"].dtype == np.uint8
    assert 0.0 < float(capsys.readouterr().out.split()[0]) <= 1.0


def test_the_film_example_leaves_a_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run(example("film.encode"))
    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.n_frames == 41
        assert names["picture"].shape[1] > gif.width


def test_the_table_names_every_metric() -> None:
    table = PAGE.read_text(encoding="utf-8").split("### What an episode comes to")[1].split("###")[0]
    shown = set(re.findall(r"`(\w+)`", table))
    told = set(EpisodeMetrics.__dataclass_fields__) | {
        name for name, value in vars(EpisodeMetrics).items() if isinstance(value, property)
    }
    assert told <= shown
