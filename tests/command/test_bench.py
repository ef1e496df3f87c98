"""`imagine bench twin`: what it measures, shows and writes, and what it refuses."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from pathlib import Path

import pytest
from PIL import Image

from imagine.bench_command import numbers, twin_plan
from imagine.cli import main
from imagine.core.errors import InputError

QUICK = ["bench", "twin", "--quick", "--level", "0", "--beams", "360"]


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
    results, plot = tmp_path / "out.json", tmp_path / "growth.png"
    status, out, err = run(
        *QUICK, "--worlds", "4,1", "--drones", "1,2", "--seconds", "0.05", "--json", results, "--plot", plot
    )
    assert status == 0, err
    told = json.loads(results.read_text())
    assert all({"value", "unit"} <= row.keys() for row in told.values())
    expected = {
        "worlds_1",
        "worlds_4",
        "drones_1",
        "drones_2",
        "memory_a_drone",
        "resident_a_drone",
        "time_growth_worlds",
        "cores",
    }
    expected |= {f"{who}_360_beams" for who in ("batched", "plain", "plain_scipy", "plain_kernels")}
    expected |= {f"batched_over_{who}_360_beams_random" for who in ("plain", "plain_scipy", "plain_kernels")}
    assert expected <= told.keys()
    assert told["batched_over_plain_360_beams"]["per_cpu_s"] > 2.0
    for text in ("plain-kernels", "Growth with worlds", "Growth with drones", "observe", "rest", "MB a drone"):
        assert text in out
    assert "round 1 of" in err
    with Image.open(plot) as picture:
        assert picture.width > 1000
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 20


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--worlds", "many"], "--worlds many: expected whole numbers"),
        (["--worlds", "1,,4"], "--worlds 1,,4: expected whole numbers"),
        (["--worlds", "0"], "--worlds 0: 0 is not from 1 to 4096"),
        (["--worlds", "4,4"], "--worlds 4,4: names a number twice"),
        (["--drones", "1,17"], "--drones 1,17: 17 is not from 1 to 16"),
        (["--beams", "2"], "--beams 2: 2 is not from 4 to 4096"),
        (["--beams", ""], "--beams : expected whole numbers"),
        (["--seconds", "nan"], "--seconds nan: give from 0.05 to 600"),
        (["--seconds", "0"], "--seconds 0: give from 0.05 to 600"),
        (["--seconds", "soon"], "--seconds"),
        (["--level", "9"], "unknown level '9'"),
        (["--json", "missing/out.json"], "missing/out.json: its folder does not exist"),
        (["--plot", "growth.pdf"], "--plot growth.pdf: the plot is drawn as PNG"),
        (["--plot", "missing/growth.png"], "missing/growth.png: its folder does not exist"),
        (["--fast"], "--fast"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_wrong_flags_are_one_line_and_status_2(arguments: list[str], said: str) -> None:
    status, out, err = run("bench", "twin", *arguments)
    assert status == 2
    assert out == ""
    assert err.startswith("imagine: ")
    assert said in err
    assert err.count("\n") == 1


def test_a_level_the_plain_step_lacks_something_of_is_refused(tmp_path: Path) -> None:
    level = tmp_path / "busy.yaml"
    level.write_text('extends: "0"\npeople:\n  - loop: [[1, 1], [5, 1]]\n')
    status, _, err = run(*QUICK[:-4], "--level", level)
    assert status == 2
    assert "busy.yaml: has people or crates" in err
    tight = tmp_path / "tight.yaml"
    tight.write_text("size_m: [1.0, 1.0]\nlaunch: [0.5, 0.5]\n")
    status, _, err = run(*QUICK[:-4], "--level", tight)
    assert status == 2
    assert "level tight: room for" in err


def test_flags_make_the_plan() -> None:
    plan = twin_plan("0", "360,64", "16,2", "3,1", None, quick=False)
    assert (plan.level, plan.beams, plan.worlds, plan.drones) == ("0", (360, 64), (2, 16), (1, 3))
    assert (plan.compared_worlds, plan.compared_drones) == (64, 3)
    quick = twin_plan("0", "64", None, None, 2.0, quick=True)
    assert quick.seconds == 2.0
    assert quick.compared_worlds < plan.compared_worlds
    with pytest.raises(InputError, match=r"--worlds 1\.5"):
        numbers("--worlds", "1.5", 1, 8)
