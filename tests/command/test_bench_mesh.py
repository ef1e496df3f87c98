"""`imagine bench mesh`: what it measures, shows and writes, and what it refuses."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is not installed: it comes with the extra 'train'")

from imagine.cli import main


def run(*arguments: str | Path) -> tuple[int, str, str]:
    """Run the command in this process; return its status, output and errors."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["imagine", *map(str, arguments)])
        patch.setenv("COLUMNS", "120")
        with pytest.raises(SystemExit) as exit_:
            main()
    assert isinstance(exit_.value.code, int)
    return exit_.value.code, out.getvalue(), err.getvalue()


def test_a_quick_run_measures_shows_and_writes_everything(tmp_path: Path) -> None:
    results = tmp_path / "out.json"
    status, out, err = run("bench", "mesh", "--quick", "--level", "4", "--json", results)
    assert status == 0, err
    told = json.loads(results.read_text())
    assert all({"value", "unit"} <= row.keys() for row in told.values())
    assert told["partition_heals"]["value"] <= 2.0
    assert told["bytes_whole_maps_over_mesh"]["value"] > 1.0
    assert told["received"]["dropped"] == {}
    assert not told["hostile"]["state_changed"]
    assert told["hostile"]["refused"] == told["hostile"]["value"]
    assert told["crowd_converges"]["value"] is not None
    assert {"handover", "scheduler_near_lacking", "scheduler_cut_lacking"} <= told.keys()
    for text in ("partition heals", "whole maps", "datagrams/s"):
        assert text in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--flights", "0"], "--flights 0: give from 1 to 100"),
        (["--minutes", "-1"], "--minutes -1: give from 0 to 600"),
        (["--hostile", "3"], "--hostile 3: give from 1000"),
        (["--json", "missing/out.json"], "missing/out.json: its folder does not exist"),
        (["--level", "9", "--quick"], "unknown level '9'"),
    ],
)
def test_wrong_flags_are_one_line_and_status_2(arguments: list[str], said: str) -> None:
    status, out, err = run("bench", "mesh", *arguments)
    assert status == 2
    assert out == ""
    assert said in err
