"""A runner killed in flight: its vehicle fails safe, its team flies on, and the pilot is told why."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest
from command_line import POLICY, Running, all_flying, wait_state

pytestmark = [
    pytest.mark.sitl,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds runners in /proc"),
]
VICTIM = 2


def test_a_killed_runner_is_one_drones_failure_alone(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    with Running("fly", "--sim", "--level", "1", "--ticks", "110", "--port", "0", *POLICY, "--json", out) as flight:
        page = flight.page()
        before = wait_state(page, all_flying(3))
        os.kill(flight.runners()[VICTIM], signal.SIGKILL)
        killed = time.monotonic()
        told = wait_state(page, lambda s: "SIGKILL" in s["drones"][VICTIM - 1]["note"])
        assert time.monotonic() - killed < 2.0
        assert told["drones"][VICTIM - 1]["lost"]
        assert any(e["drone"] == VICTIM and "runner process killed by SIGKILL" in e["text"] for e in told["events"])
        landing = wait_state(page, lambda s: "offboard stream lost" in s["drones"][VICTIM - 1]["note"])
        assert landing["drones"][VICTIM - 1]["stale"]
        assert [d["stale"] for d in landing["drones"] if d["id"] != VICTIM] == [False, False]
        status = flight.end()
    assert status == 1
    assert flight.errors == [f"imagine: drone {VICTIM}: runner process killed by SIGKILL"]
    found = json.loads(out.read_text())
    assert found["ticks"] == 110
    victim, *others = sorted(found["drones"], key=lambda d: d["id"] != VICTIM)
    (failsafe,) = victim["failsafes"]
    assert failsafe["kind"] == "vehicle"
    assert failsafe["text"] == "offboard stream lost"
    # the state was published up to 0.2 s before the kill: the true delay is shorter
    assert 0.0 < failsafe["time_s"] - before["time_s"] <= 1.5
    for drone in others:
        assert drone["error"] == ""
        assert drone["failsafes"] == []
        assert drone["setpoints"] > 90
        assert drone["pose_rmse_m"] < 0.15
