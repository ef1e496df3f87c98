"""The real `imagine` command for tests: run it, watch it, find its drones' processes."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any

from imagine.onboard.settings import DEFAULT_POLICY

IMAGINE = [sys.executable, "-m", "imagine"]
SHIPPED_POLICY = DEFAULT_POLICY.exists()
POLICY = [] if SHIPPED_POLICY else ["--policy", "frontier"]
"""Flags that make a flight use the shipped policy, or the planner in a checkout that has none yet."""

DEADLINE_S = 120.0


def environment(**changes: str | None) -> dict[str, str]:
    """This process's environment without colours and keys; None takes a variable away."""
    wanted: dict[str, str | None] = {
        **os.environ, "NO_COLOR": "1", "COLUMNS": "120", "IMAGINE_MESH_KEY": None, "PYTHONUNBUFFERED": None, **changes,
    }  # fmt: skip
    return {name: value for name, value in wanted.items() if value is not None}


def run_imagine(
    *arguments: str | Path, cwd: Path | None = None, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
    return subprocess.run(
        [*IMAGINE, *map(str, arguments)],
        capture_output=True, text=True, timeout=DEADLINE_S, cwd=cwd, env=env or environment(), check=False,
    )  # fmt: skip


def fly(out: Path, *arguments: str) -> dict[str, Any]:
    """Fly headless with the shipped policy, expect success, and return the flight's JSON."""
    done = run_imagine("fly", "--sim", "--headless", *POLICY, *arguments, "--json", out)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    found: dict[str, Any] = json.loads(out.read_text())
    return found


class Running:
    """A command that runs beside the test; leaving the context kills what is left of it."""

    def __init__(self, *arguments: str | Path, env: dict[str, str] | None = None) -> None:
        self.process = subprocess.Popen(
            [*IMAGINE, *map(str, arguments)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env or environment(),
        )  # fmt: skip
        self.lines: list[str] = []
        self.errors: list[str] = []
        self._fresh: queue.Queue[str | None] = queue.Queue()
        self._readers = [
            threading.Thread(target=self._read, args=(self.process.stdout, self.lines, True), daemon=True),
            threading.Thread(target=self._read, args=(self.process.stderr, self.errors, False), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, stream: Any, lines: list[str], tell: bool) -> None:
        for line in stream:
            lines.append(line.rstrip("\n"))
            if tell:
                self._fresh.put(line.rstrip("\n"))
        if tell:
            self._fresh.put(None)

    def line_with(self, text: str) -> str:
        """Wait for a line on standard output that holds `text`, and return it."""
        end = time.monotonic() + DEADLINE_S
        while (line := self._fresh.get(timeout=max(0.1, end - time.monotonic()))) is not None:
            if text in line:
                return line
        raise AssertionError(f"it ended without saying {text!r}: {self.lines} {self.errors}")

    def page(self) -> str:
        """Wait for the ground station's address and return it."""
        return self.line_with("ground station:").split()[-1].rstrip("/")

    def end(self, timeout_s: float = DEADLINE_S) -> int:
        """Wait for the end and return the exit status, with all output read."""
        status = self.process.wait(timeout_s)
        for reader in self._readers:
            reader.join(5.0)
        return status

    def runners(self) -> dict[int, int]:
        """The process ids of the drones' runners, by drone."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        found = {}
        for child in children:
            words = Path(f"/proc/{child}/cmdline").read_bytes().decode().split("\0")
            drone = next((w for w in words if Path(w).name.startswith("drone-")), None)
            if "imagine.onboard" in words and drone is not None:
                found[int(Path(drone).stem.removeprefix("drone-"))] = int(child)
        return found

    def __enter__(self) -> Running:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.end()


def state(page: str) -> dict[str, Any] | None:
    """What the ground station's `/api/state` tells now."""
    with urllib.request.urlopen(f"{page}/api/state", timeout=10) as answer:
        told: dict[str, Any] | None = json.load(answer)
    return told


def wait_state(page: str, condition: Any, timeout_s: float = DEADLINE_S) -> dict[str, Any]:
    """Ask `/api/state` until `condition(state)` holds; return that state."""
    end = time.monotonic() + timeout_s
    while True:
        told = state(page)
        if told is not None and condition(told):
            return told
        assert time.monotonic() < end, f"never came true; the ground station has {told}"
        time.sleep(0.02)  # between two questions, not instead of one


def all_flying(drones: int) -> Any:
    """A condition for `wait_state`: so many drones are in the air."""
    return lambda told: sum(d["flying"] and d["height_m"] > 0.7 for d in told["drones"]) == drones


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended but was not asked about does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False
