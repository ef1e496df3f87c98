"""`imagine bench train`: what it measures, shows and writes, and what it refuses."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is not installed: it comes with the extra 'train'")

from imagine.bench_train_command import bench_settings
from imagine.cli import main

SMALL = ["env.observation.view_cells=16", "env.observation.lidar_sectors=16", "run.threads=1"]


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


@pytest.mark.parametrize("overrides", [[], ["network.paradigm=dtde", "network.memory=gru", "ppo.precision=float32"]])
def test_a_quick_run_measures_shows_and_writes_every_stage(tmp_path: Path, overrides: list[str]) -> None:
    results = tmp_path / "out.json"
    flags = [part for override in [*SMALL, *overrides] for part in ("--set", override)]
    status, out, err = run("bench", "train", "smoke", "--quick", "--worlds", "2", "--json", results, *flags)
    assert status == 0, err
    told = json.loads(results.read_text())
    assert all({"value", "unit"} <= row.keys() for row in told.values())
    stages = {"rollout", "update", "env", "level_images", "acting", "values"}
    ticks = {f"env_{name}" for name in ("fly", "scan", "share", "derive", "observe")}
    assert stages | ticks | {"training", "parameters", "cores"} == told.keys()
    assert all(told[name]["value"] > 0.0 for name in ticks)
    assert sum(told[name]["value"] for name in ticks) < told["rollout"]["cpu"]
    assert told["training"]["worlds"] == 2
    if overrides:
        assert told["training"]["precision"] == "float32"
    whole = told["rollout"]["value"] + told["update"]["value"]
    assert 1e6 / told["training"]["value"] == pytest.approx(whole)  # of a single round
    assert told["env"]["value"] < told["rollout"]["value"]
    for text in ("2 worlds of 3 drones", "the twin", "  derive", "update", "agent-steps/s", "weights"):
        assert text in out
    assert "round 1 of 1" in err


def test_without_flags_it_measures_the_default_network_in_64_worlds_of_3() -> None:
    settings = bench_settings(None, None, None, False, ())
    assert (settings.env.worlds, settings.env.drones) == (64, 3)
    assert (settings.network.paradigm, settings.network.memory, settings.network.encoder) == (
        "ctde",
        "none",
        "separate",
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--worlds", "0"], "--worlds 0: give from 1 to 4096"),
        (["--drones", "17"], "--drones 17: give from 1 to 16"),
        (["--rounds", "0"], "--rounds 0: give from 1 to 1000"),
        (["--set", "network.memry=gru"], "unknown key 'network.memry'; did you mean 'memory'"),
        (["nowhere.yaml"], "nowhere.yaml"),
        (["--json", "missing/out.json"], "missing/out.json: its folder does not exist"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_wrong_flags_are_one_line_and_status_2(arguments: list[str], said: str) -> None:
    status, out, err = run("bench", "train", *arguments)
    assert status == 2
    assert out == ""
    assert err.startswith("imagine: ")
    assert said in err
    assert err.count("\n") == 1
