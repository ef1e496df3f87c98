"""`imagine evaluate`: several policies over the same episodes, and results that stay whatever happens."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from command_line import DEADLINE_S, Running, environment, run_imagine

pytest.importorskip("torch", reason="the train extra is not installed")

from imagine.core.errors import WorkError
from imagine.evaluate_command import EvaluateOptions, evaluate_and_show
from imagine.evaluate_table import short_level
from imagine.train.evaluation.comparison import Comparison


def test_policies_levels_teams_and_protocols_in_one_table(tmp_path: Path) -> None:
    table, episodes, plots = tmp_path / "table.json", tmp_path / "episodes.jsonl", tmp_path / "plots"
    done = run_imagine(
        "evaluate", "--policy", "random", "--policy", "frontier", "--levels", "0,1", "--drones", "1,2", "--protocol",
        "off,one-hop", "--episodes", "2", "--launch", "random", "--set", "env.episode_ticks=60", "--json", table,
        "--episodes-json", episodes, "--plots", plots, env=environment(COLUMNS="80"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = json.loads(table.read_text())
    assert [row["policy"] for row in rows] == ["random"] * 12 + ["frontier"] * 12
    places = [(row["protocol"], row["drones"], row["level"]) for row in rows[:12]]
    assert places == [(p, n, level) for p in ("off", "one-hop") for n in (1, 2) for level in ("0", "1", "all")]
    assert {row["paired"]["against"] for row in rows[:12]} == {"frontier"}
    assert all(row["paired"] is None for row in rows[12:])
    told = [json.loads(line) for line in episodes.read_text().splitlines()]
    assert len(told) == 2 * 8 * 2
    mine = [e for e in told if (e["policy"], e["level"], e["drones"], e["protocol"]) == ("random", "1", 2, "off")]
    assert [e["episode"] for e in mine] == [0, 1]
    (row,) = [r for r in rows[:12] if (r["level"], r["drones"], r["protocol"]) == ("1", 2, "off")]
    assert row["coverage_mean"] == pytest.approx(sum(e["coverage"] for e in mine) / 2)
    assert len(list(plots.glob("*.png"))) == 12
    assert "2 episodes each, random launches" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert "random: level 0, 1 drone, off" in done.stderr


def options(tmp_path: Path, **changes: Any) -> EvaluateOptions:
    given: dict[str, Any] = {
        "policies": ("random",), "levels": "0,1", "drones": "1", "episodes": 2, "overrides": ("env.episode_ticks=30",),
        "json_file": tmp_path / "rows.json",
    }  # fmt: skip
    return EvaluateOptions(**(given | changes))


def test_rows_are_written_as_they_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    take = Comparison._take

    def look_then_take(self: Comparison, flight: Any) -> Any:
        path = tmp_path / "rows.json"
        seen.append(len(json.loads(path.read_text())) if path.exists() else 0)
        return take(self, flight)

    monkeypatch.setattr(Comparison, "_take", look_then_take)
    evaluate_and_show(options(tmp_path, levels="0,1,2"))
    assert seen == [0, 1, 2]
    assert len(json.loads((tmp_path / "rows.json").read_text())) == 4  # and all levels together


def test_an_interruption_keeps_what_was_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    take = Comparison._take

    def interrupt_at_the_third(self: Comparison, flight: Any) -> Any:
        if len(self.flown) == 2:
            signal.raise_signal(signal.SIGTERM)
        return take(self, flight)

    monkeypatch.setattr(Comparison, "_take", interrupt_at_the_third)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(WorkError, match=r"interrupted; 2 of 4 rows were done, kept in .*rows\.json") as caught:
        evaluate_and_show(options(tmp_path, levels="0-3"))
    assert caught.value.exit_status == 1
    assert [row["level"] for row in json.loads((tmp_path / "rows.json").read_text())] == ["0", "1"]
    assert "level" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGTERM) == before


def test_ctrl_c_ends_the_real_command_with_status_1(tmp_path: Path) -> None:
    rows = tmp_path / "rows.json"
    with Running("evaluate", "--policy", "random", "--levels", "0-6", "--episodes", "50", "--json", rows) as running:
        end = time.monotonic() + DEADLINE_S
        while not rows.exists() and time.monotonic() < end:
            time.sleep(0.02)  # between two looks, not instead of one
        running.process.send_signal(signal.SIGINT)
        assert running.end() == 1
    assert json.loads(rows.read_text())[0]["level"] == "0"
    assert any("interrupted" in line for line in running.errors)


def test_files_are_shown_by_their_own_names() -> None:
    assert short_level("house:3:120") == "house:3:120"
    assert short_level("../plans/0a1b2c3d4e5f6a7b8c9d.json") == "0a1b2c3d4e..8c9d"
    assert short_level("6") == "6"
