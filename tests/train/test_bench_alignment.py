"""The bench of frame alignment: drones of one flight find each other, and a wrong place would be told."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from imagine.mesh_comm.alignment import AlignmentSettings
from imagine.train.bench_alignment import Look, Member, Trial, attempt_pair, fly, summary


@pytest.fixture(scope="module")
def trial() -> Trial:
    flights = fly("6", drift=True, worlds=1, seed=3)
    pair = Member(flights, 0, 0), Member(flights, 0, 1)
    return attempt_pair(*pair, 20, True, "one flight", np.random.default_rng(1), AlignmentSettings())


def test_drones_of_one_flight_find_each_other_within_the_bars(trial: Trial) -> None:
    figures = summary([trial])
    assert figures["wrong_pairs"]["value"] == 0
    assert figures["places_off_the_bar"] == {"value": 0, "unit": "attempts", "of": pytest.approx(15, abs=6)}
    assert trial.looks[-1].trusted
    assert not trial.looks[0].trusted  # one estimate is never enough
    assert figures["error_p100"]["value"] < 0.1


def test_a_wrong_place_and_any_place_among_two_levels_are_counted(trial: Trial) -> None:
    wrong = Look(3.0, 0.5, trusted=True, error_m=1.0, error_rad=0.0, cpu_s=0.1)
    misplaced = dataclasses.replace(trial, looks=(*trial.looks, wrong))
    foreign = Trial("5", "6", "two levels", False, (Look(3.0, 0.0, True, math.inf, math.inf, 0.1),))
    careful = Trial("5", "6", "two levels", False, (Look(3.0, 0.0, False, math.inf, math.inf, 0.1),))
    figures = summary([misplaced, foreign, careful, trial])
    assert figures["wrong_pairs"]["value"] == 2
    assert figures["places_off_the_bar"]["value"] == 1
