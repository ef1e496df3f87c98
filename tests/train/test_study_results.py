import csv
import json

import numpy as np
import pytest
from PIL import Image

from imagine.train.study.folder import StudyFolder
from imagine.train.study.outcome import Outcome, log_attempt, read_attempts, read_outcome, write_outcome
from imagine.train.study.plan import plan_trials
from imagine.train.study.plot import plot_summary
from imagine.train.study.results import mean_interval, study_data, write_results
from imagine.train.study.run import StudyResult
from imagine.train.study.settings import StudySettings
from imagine.train.study.trial import outcome_of


@pytest.fixture
def data(tmp_path):
    """Two conditions with three repeats each, one of whose trials failed, and one that has not ended."""
    study = StudySettings(
        name="s",
        base="smoke",
        root=str(tmp_path),
        parameters={"grid": {"env.drones": [1, 2, 3]}},
        repeats=3,
        metric="t90",
    )
    trials = plan_trials(study)
    outcomes = {}
    for trial in trials:
        slow = {1: 300.0, 2: 200.0, 3: 250.0}[trial.settings.env.drones] + 10.0 * trial.seed
        levels = {
            "4": {"coverage": 0.9, "t90": slow, "contacts": 0.0},
            "5": {"coverage": 1.0, "t90": slow + 100.0, "contacts": 1.0},
        }
        outcomes[trial.name] = Outcome("finished", 1000, 12.5, levels, "evaluation")
    outcomes[trials[-1].name] = None
    outcomes[trials[-2].name] = Outcome("failed", 10, 0.5, {}, error="WorkError: diverged")
    folder = StudyFolder(study)
    log_attempt(folder.run(trials[0].name), 0)
    log_attempt(folder.run(trials[0].name), 640)
    return study_data(study, StudyResult(folder, trials, outcomes, stopped=""))


def test_conditions_are_ranked_by_the_metric_with_intervals_over_repeats(data):
    assert [row["condition"] for row in data["conditions"]] == ["env.drones=2", "env.drones=3", "env.drones=1"]
    best, _, worst = data["conditions"]
    assert worst["t90"] == pytest.approx(360.0)  # means over levels 4 and 5 are 350, 360, 370
    low, high = worst["t90_ci95"]
    assert (high - low) / 2.0 == pytest.approx(4.303 * 10.0 / np.sqrt(3.0), rel=1e-3)  # Student's t, two degrees
    assert (best["trials"], best["ended"]) == (3, 2)  # the failed one counts for nothing
    assert best["t90"] == pytest.approx(255.0)
    assert not data["finished"]


def test_a_single_value_has_no_interval():
    assert mean_interval([3.0]) is None
    assert mean_interval([]) is None
    assert mean_interval([3.0, 3.0]) == (3.0, 3.0)


def test_files_hold_every_trial_with_parameters_and_levels(data, tmp_path):
    write_results(tmp_path, data)
    assert json.loads((tmp_path / "results.json").read_text()) == json.loads(json.dumps(data))
    rows = list(csv.DictReader((tmp_path / "results.csv").open()))
    assert len(rows) == 9
    assert [row["status"] for row in rows] == ["finished"] * 7 + ["failed", "unfinished"]
    assert (rows[0]["env.drones"], rows[0]["level_5_t90"], rows[0]["resumed_from"]) == ("1", "400.0", "640")
    assert (rows[0]["workers"], rows[7]["error"]) == ("2", "WorkError: diverged")


def test_the_plot_shows_the_best_condition_first(data, tmp_path):
    plot_summary(tmp_path / "summary.png", data)
    pixels = np.asarray(Image.open(tmp_path / "summary.png").convert("RGB")).astype(int)
    best = (np.abs(pixels - (0x1B, 0x6C, 0xA8)).sum(axis=2) < 12).any(axis=1)
    other = (np.abs(pixels - (0x9D, 0xB8, 0xCF)).sum(axis=2) < 12).any(axis=1)
    assert best.any()
    assert np.flatnonzero(best).max() < np.flatnonzero(other).min()
    empty = {**data, "conditions": [{**row, "t90": None} for row in data["conditions"]]}
    plot_summary(tmp_path / "none.png", empty)
    assert not (tmp_path / "none.png").exists()


def test_outcomes_and_attempts_survive_the_disk_and_half_a_line(tmp_path):
    assert read_outcome(tmp_path) is None
    outcome = Outcome("pruned", 5, 1.5, {"4": {"coverage": 0.5}}, "training")
    write_outcome(tmp_path, outcome)
    assert read_outcome(tmp_path) == outcome
    log_attempt(tmp_path, 12)
    with (tmp_path / "attempts.jsonl").open("a") as file:
        file.write('{"pid": 12, "ho')
    assert [attempt.resumed_from for attempt in read_attempts(tmp_path)] == [12]


def test_a_finished_trial_is_told_by_its_evaluation_and_a_cut_one_by_its_training(tmp_path):
    row = {"agent_steps": 640, "wall_s": 2.0, "levels": {"4": {"coverage": 0.5, "t90": 900.0, "contacts": 0.0}}}
    (tmp_path / "reports.jsonl").write_text(json.dumps(row) + "\n" + '{"agent_st')
    rows = [{"level": "4", "coverage_mean": 0.99, "t90_mean": 321.0, "collisions_per_episode": 0.5}]
    (tmp_path / "evaluation.json").write_text(json.dumps({"rows": rows}))
    finished, cut = outcome_of(tmp_path, "finished"), outcome_of(tmp_path, "time limit")
    assert finished.levels == {"4": {"coverage": 0.99, "t90": 321.0, "contacts": 0.5}}
    assert (finished.source, cut.source, cut.agent_steps) == ("evaluation", "training", 640)
    assert cut.levels == row["levels"]
