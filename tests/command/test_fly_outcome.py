"""What a simulated flight gives its runners, and what of its outcome counts as a failure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from imagine.fly_command import failures
from imagine.mesh_comm.keys import next_boot_number
from imagine.mesh_comm.seal import KEY_BYTES
from imagine.onboard.build import mesh_sealer
from imagine.onboard.settings import DroneSettings
from imagine.runner_processes import RunnerProcesses

KEY = {"IMAGINE_MESH_KEY": bytes(KEY_BYTES).hex()}
MESHED = DroneSettings(drone_id=7, mesh="udpout://127.0.0.1:1")


def drone(number: int, error: str = "", *failsafes: tuple[str, str]) -> dict[str, Any]:
    return {"id": number, "error": error, "failsafes": [{"kind": kind, "text": text} for kind, text in failsafes]}


def test_a_runners_failsafe_fails_the_flight_and_names_the_drone() -> None:
    lost = ("runner", "land: lost for 3.0 s")
    assert failures([drone(1), drone(2, "", lost)]) == ["drone 2: failsafe: land: lost for 3.0 s"]
    assert failures([drone(1, "runner process killed by SIGKILL", ("vehicle", "offboard stream lost"))]) == [
        "drone 1: runner process killed by SIGKILL"
    ]
    assert failures([drone(1), drone(2, "", ("vehicle", "offboard stream lost"))]) == []


def test_a_simulated_flight_keeps_its_boot_numbers_with_its_other_files() -> None:
    with RunnerProcesses(1) as processes:
        processes.fly([MESHED.model_copy(update={"drone_id": 1})])
        given = json.loads((processes.folder / "drone-1.yaml").read_text())
        assert Path(given["boot_file"]).parent == processes.folder


def test_a_drone_started_twice_in_a_second_or_with_a_wrong_clock_never_seals_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    sealed = [mesh_sealer(MESHED, KEY, at) for at in (2e9, 2e9, 0.0)]
    boots = [sealer.boot for sealer in sealed if sealer is not None]
    assert boots[0] < boots[1] < boots[2]
    assert next_boot_number(tmp_path / ".imagine" / "drone-7.boot", 0.0) == boots[2] + 1
