"""How a flight ends before its time: Ctrl-C lands it, and runners do not outlive the command."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import pytest
from command_line import POLICY, Running, all_flying, is_alive, wait_state

pytestmark = [
    pytest.mark.sitl,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds runners in /proc"),
]


def test_ctrl_c_lands_the_drones_and_ends_well(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    command = ["fly", "--sim", "--level", "0", "--drones", "2", "--speed", "2", "--port", "0", *POLICY]
    with Running(*command, "--json", out) as flight:
        wait_state(flight.page(), all_flying(2))
        runners = flight.runners()
        flight.process.send_signal(signal.SIGINT)
        status = flight.end()
    assert (status, flight.errors) == (0, [])
    assert any("landing all drones" in line for line in flight.lines)
    found = json.loads(out.read_text())
    assert found["ticks"] < 300  # of 1000
    for drone in found["drones"]:
        assert drone["phase"] == "done"
        assert drone["failsafes"] == []
    assert not any(is_alive(pid) for pid in runners.values())


def test_runners_end_soon_after_the_command_is_killed() -> None:
    with Running("fly", "--sim", "--level", "0", "--drones", "2", "--port", "0", *POLICY) as flight:
        wait_state(flight.page(), lambda told: len(told["drones"]) == 2)
        runners = flight.runners()
        assert len(runners) == 2
        flight.process.kill()
        end = time.monotonic() + 10.0
        while any(is_alive(pid) for pid in runners.values()):
            assert time.monotonic() < end, "a runner outlives the command that started it"
            time.sleep(0.02)


def test_ctrl_c_before_takeoff_leaves_nothing_running() -> None:
    with Running("fly", "--sim", "--level", "0", "--drones", "2", "--port", "0", *POLICY) as flight:
        flight.page()  # served, but nobody flies yet
        runners = flight.runners()
        flight.process.send_signal(signal.SIGINT)
        assert flight.end() in (0, 130)  # 0 where it just took off
    assert len(runners) == 2
    assert not any(is_alive(pid) for pid in runners.values())
