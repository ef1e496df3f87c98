"""What a terminal shows of a run."""

import io
import logging
import re
import sys

import pytest
from rich.console import Console

from imagine.cli import main
from imagine.train.report import LiveReporter, LogReporter, Report, one_line
from imagine.train.tracking.episodes import TEAM_METRICS


def report(levels, numbers=24, done=500):
    names = ["action_std", "policy_loss", "value_loss", "kl", *(f"number_{k}" for k in range(numbers - 4))]
    return Report(
        phase="ppo",
        agent_steps=done,
        phase_steps=done,
        phase_total=2000,
        numbers=dict.fromkeys(names, 0.125),
        levels={name: dict.fromkeys(TEAM_METRICS, coverage) for name, coverage in levels.items()},
        steps_per_s=10.0,
        seconds={"env": 1.0, "act": 0.5, "update": 2.0},
        wall_s=90.0,
    )


def screen(what):
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=24, color_system=None)
    with LiveReporter(console) as live:
        live(what)
    drawn = re.sub(r"\x1b\[[?0-9;]*[A-Za-z]", "", console.file.getvalue()).replace("\r", "")
    last = drawn[drawn.rindex("       ppo") :]  # each redrawing begins with the progress
    return [line.rstrip() for line in last.splitlines() if line.strip()]


def test_seven_levels_and_many_numbers_fit_on_one_screen():
    lines = screen(report({str(k): 0.9 + k / 100 for k in range(7)}))
    text = "\n".join(lines)
    assert len(lines) <= 23
    assert all(len(line) <= 80 for line in lines)
    for wanted in ("500/2000", "10 steps/s", "policy_loss 0.125", "kl 0.125", "update 2.0 s", "coverage", "0.960"):
        assert wanted in text
    assert "number_19" not in text


def test_of_many_levels_the_worst_are_shown():
    lines = screen(report({f"plan{k:02}": 0.5 + k / 100 for k in range(30)}))
    text = "\n".join(lines)
    assert len(lines) <= 23
    assert "plan00" in text
    assert "plan29" not in text
    assert "all, 20 better not shown" in text


def test_a_line_says_how_far_how_fast_and_how_long():
    line = one_line(report({"4": 0.75}))
    assert line.startswith("ppo 500/2000 10 steps/s 2.5 min left | policy_loss=0.125 value_loss=0.125 kl=0.125")
    assert line.endswith("4:0.75/1")
    assert "(no episode yet)" in one_line(report({}))


def test_without_a_terminal_lines_are_logged_now_and_then(caplog):
    follow = LogReporter(every_s=3600.0)
    with caplog.at_level(logging.INFO):
        follow(report({}))
        follow(report({}))
    assert len(caplog.records) == 1


def test_overall_figures_count_levels_alike():
    mixed = report({"0": 1.0, "6": 0.5})
    assert mixed.overall["coverage"] == mixed.coverage == pytest.approx(0.75)
    assert mixed.scalars()["paradigm/ctde/coverage"] == pytest.approx(0.75)
    assert mixed.scalars()["ppo/kl"] == 0.125
    assert report({}).overall == {}


def test_without_a_terminal_the_command_writes_lines_to_the_log(tmp_path, monkeypatch, caplog):
    """Else a run in a job's log would say nothing for hours."""
    small = ("env.worlds=1", "imitation.agent_steps=0", "ppo.agent_steps=64", "env.observation.view_cells=16")
    flags = [flag for text in (*small, f"run.root={tmp_path}", "run.threads=1") for flag in ("--set", text)]
    monkeypatch.setattr(sys, "argv", ["imagine", "train", "smoke", *flags])
    try:
        with pytest.raises(SystemExit) as ended:
            main()
    finally:
        logging.getLogger("imagine.train").setLevel(logging.NOTSET)
    assert ended.value.code == 0
    assert any(line.startswith("ppo 64/64") for line in caplog.messages)
