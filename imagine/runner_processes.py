"""The drones' processes of a simulated flight: started, watched, ended, and asked why they died."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from imagine.core.errors import WorkError
from imagine.mesh_comm.keys import KEY_VARIABLE
from imagine.onboard.settings import DroneSettings

_END_DEADLINE_S = 8.0


class RunnerProcesses:
    """One `python -m imagine.onboard` per drone, with its log, report and map in a folder that goes with it.

    Drones are numbered from 1. Leaving the context ends every process, by SIGKILL if it must be.
    """

    def __init__(self, settings: Sequence[DroneSettings], key: bytes) -> None:
        """Start the processes; `key` is the swarm's, and reaches them by their environment alone."""
        self._folder = tempfile.TemporaryDirectory(prefix="imagine-flight-")
        self.folder = Path(self._folder.name)
        # One thread each: three drones share the cores of one machine here, as they would not in flight.
        environment = {**os.environ, KEY_VARIABLE: key.hex(), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._stopped: set[int] = set()
        for drone in settings:
            number = drone.drone_id
            wired = drone.model_copy(
                update={"report": self._file(number, "json"), "map_out": self._file(number, "npz")}
            )
            path = self._file(number, "yaml")
            path.write_text(wired.model_dump_json(), encoding="utf-8")  # JSON is YAML
            with self._file(number, "log").open("wb") as log:
                self._processes[number] = subprocess.Popen(
                    [sys.executable, "-m", "imagine.onboard", str(path)],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env=environment,
                    start_new_session=True,  # Ctrl-C is for the flight, which then lands its drones
                )

    def _file(self, number: int, kind: str) -> Path:
        return self.folder / f"drone-{number}.{kind}"

    def is_running(self, number: int) -> bool:
        """Tell whether a drone's process lives."""
        return self._processes[number].poll() is None

    def pid(self, number: int) -> int:
        """Return the process id of a drone."""
        return self._processes[number].pid

    def any_running(self) -> bool:
        """Tell whether any drone's process lives."""
        return any(process.poll() is None for process in self._processes.values())

    def ended_badly(self, number: int) -> str:
        """Return why a drone's process ended, in words for the pilot; empty while it runs or when it ended well."""
        status = self._processes[number].poll()
        if status is None or status == 0 or number in self._stopped:
            return ""
        if status < 0:
            return f"runner process killed by {signal.Signals(-status).name}"
        return f"runner process ended with status {status}: {self.last_words(number)}"

    def last_words(self, number: int) -> str:
        """Return the last line of a drone's log."""
        lines = self._file(number, "log").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1].removeprefix("imagine: ") if lines else "it said nothing"

    def exit_status(self, number: int) -> int | None:
        """Return a drone's exit status, None while it runs."""
        return self._processes[number].poll()

    def request_end(self) -> None:
        """Ask every process to land its drone and end."""
        for process in self._processes.values():
            if process.poll() is None:
                process.terminate()

    def wait_end(self) -> None:
        """Wait until all have ended; past a deadline they are killed, which `ended_badly` then passes over."""
        deadline = time.monotonic() + _END_DEADLINE_S
        for number, process in self._processes.items():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                self._stopped.add(number)
                process.kill()
                process.wait(5.0)

    def report(self, number: int) -> dict[str, Any] | None:
        """Return the report a drone left, None if it left none (it was killed)."""
        path = self._file(number, "json")
        if not path.exists():
            return None
        report = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(report, dict):
            raise WorkError(f"drone {number}: its report is not a JSON object")
        return report

    def map_file(self, number: int) -> Path | None:
        """Return the file of the map a drone left, None if it left none."""
        path = self._file(number, "npz")
        return path if path.exists() else None

    def __enter__(self) -> RunnerProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
            process.wait(5.0)
        self._folder.cleanup()
