"""`imagine sim` serves a runner that somebody else starts, by the very command it prints."""

from __future__ import annotations

import json
import shlex
import signal
from pathlib import Path

import pytest
from command_line import POLICY, Running, environment, run_imagine

from imagine.sim.sockets import free_listen_port

pytestmark = pytest.mark.sitl


def test_a_runner_elsewhere_flies_by_the_printed_command(tmp_path: Path) -> None:
    key, report = tmp_path / "swarm.key", tmp_path / "drone.json"
    assert run_imagine("keygen", key).returncode == 0
    keyed = environment(IMAGINE_MESH_KEY=key.read_text().strip())
    base = free_listen_port("127.0.0.1")  # 14540 may be taken here
    with Running(
        "sim", "--level", "0", "--drones", "1", "--base-port", str(base), "--lockstep", "--ticks", "60"
    ) as sim:
        command = sim.line_with("drone 1: imagine fly ").partition("imagine ")[2]
        assert f"udpin://127.0.0.1:{base + 1} " in command
        boot = f"boot_file={tmp_path / 'drone.boot'}"  # not in the home folder of whoever tests
        with Running(*shlex.split(command), *POLICY, "--set", boot, "--json", report, env=keyed) as drone:
            assert sim.end() == 0, sim.errors
            drone.process.send_signal(signal.SIGINT)
            assert drone.end() == 0, drone.errors
    assert sim.errors == []
    assert any("all connected" in line for line in sim.lines)
    found = json.loads(report.read_text())
    assert found["phase"] == "explore"
    assert found["setpoints"] > 50
    assert found["distance_m"] > 0.3


def test_runners_that_never_come_are_named() -> None:
    base = free_listen_port("127.0.0.1")
    done = run_imagine("sim", "--level", "0", "--drones", "2", "--base-port", str(base), "--wait", "0.2")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("imagine: drone 1, 2 did not connect within 0.2 s")
    assert f"udpin://127.0.0.1:{base + 1}" in line


def test_ctrl_c_ends_the_wait_for_runners() -> None:
    base = free_listen_port("127.0.0.1")
    with Running("sim", "--level", "0", "--drones", "1", "--base-port", str(base)) as sim:
        sim.line_with("waiting for 1 runners")
        sim.process.send_signal(signal.SIGINT)
        assert sim.end() == 130
    assert sim.errors == ["imagine: interrupted"]
