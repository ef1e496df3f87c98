"""The drones' processes of a simulated flight: started, watched, ended, and asked why they died."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imagine.core.errors import WorkError

if TYPE_CHECKING:  # only names: this module is loaded before all others, so that the processes start at once
    from imagine.onboard.settings import DroneSettings

_END_DEADLINE_S = 15.0
_KEY_BYTES = 32


class RunnerProcesses:
    """One `python -m imagine.onboard` per drone, with its log, report and map in a folder that goes with it.

    Drones are numbered from 1. The processes load their code at once and wait for `fly`. They end when this process
    does, however it ends; leaving the context ends every one of them, by SIGKILL if it must be.
    """

    def __init__(self, drones: int) -> None:
        """Start the processes, with a new key for the swarm; it reaches them by their environment alone."""
        self.key = secrets.token_bytes(_KEY_BYTES)
        self._folder = tempfile.TemporaryDirectory(prefix="imagine-flight-", ignore_cleanup_errors=True)
        self.folder = Path(self._folder.name)
        # One thread each: three drones share the cores of one machine here, as they would not in flight.
        environment = {
            **os.environ,
            "IMAGINE_MESH_KEY": self.key.hex(),
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
        }
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._asked: set[int] = set()
        self._stopped: set[int] = set()
        try:
            for number in range(1, drones + 1):
                self._start(number, environment)
        except OSError as error:
            self.__exit__()
            raise WorkError(f"drone {len(self._processes) + 1}: its process cannot be started: {error}") from error

    def _start(self, number: int, environment: dict[str, str]) -> None:
        with self._file(number, "log").open("wb") as log:
            self._processes[number] = subprocess.Popen(
                [sys.executable, "-m", "imagine.onboard", str(self._file(number, "yaml")), "--tethered"],
                stdin=subprocess.PIPE,
                bufsize=0,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,  # Ctrl-C is for the flight, which then lands its drones
            )

    def fly(self, settings: Sequence[DroneSettings]) -> None:
        """Give every process its settings, upon which it connects."""
        for drone in settings:
            number = drone.drone_id
            wired = drone.model_copy(
                update={
                    "report": self._file(number, "json"),
                    "map_out": self._file(number, "npz"),
                    "boot_file": self._file(number, "boot"),  # the key is new, so no number has been used with it
                }
            )
            self._file(number, "yaml").write_text(wired.model_dump_json(), encoding="utf-8")  # JSON is YAML
            tether = self._processes[number].stdin
            assert tether is not None
            try:
                tether.write(b"fly\n")
            except BrokenPipeError:
                continue  # it has ended, and will be asked why

    def _file(self, number: int, kind: str) -> Path:
        return self.folder / f"drone-{number}.{kind}"

    def is_running(self, number: int) -> bool:
        """Tell whether a drone's process lives."""
        return self._processes[number].poll() is None

    def any_running(self) -> bool:
        """Tell whether any drone's process lives."""
        return any(process.poll() is None for process in self._processes.values())

    def ended_badly(self, number: int) -> str:
        """Return why a drone's process ended, in words for the pilot; empty while it runs or when it ended well."""
        status = self._processes[number].poll()
        if number in self._stopped:
            return f"runner process did not end within {_END_DEADLINE_S:.0f} s and was killed"
        # one that was on its way out when it was asked to end has died of the question
        if status is None or status == 0 or (number in self._asked and status == -signal.SIGTERM):
            return ""
        if status < 0:
            return f"runner process killed by {_signal_name(-status)}"
        return f"runner process ended with status {status}: {self.last_words(number)}"

    def last_words(self, number: int) -> str:
        """Return the last line of a drone's log."""
        lines = self._file(number, "log").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1].removeprefix("imagine: ") if lines else "it said nothing"

    def exit_status(self, number: int) -> int | None:
        """Return a drone's exit status, None while it runs."""
        return self._processes[number].poll()

    def request_end(self) -> None:
        """Ask every process, once, to land its drone and end."""
        for number, process in self._processes.items():
            if number not in self._asked and process.poll() is None:
                self._asked.add(number)
                process.terminate()

    def wait_end(self) -> None:
        """Wait until all have ended; past a deadline they are killed, and `ended_badly` says so."""
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
        for process in self._processes.values():
            process.wait(5.0)
            if process.stdin is not None:
                process.stdin.close()
        self._folder.cleanup()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal has no name
        return f"signal {number}"
