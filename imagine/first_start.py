"""The first start after an installation: every kernel is compiled once, on two cores, and kept on disk.

Left to themselves several runners would each compile the same kernels in the same moment.
`python -m imagine.first_start` compiles those of the twin.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from imagine.onboard.settings import DroneSettings
from imagine.sim.coverage import Coverage
from imagine.sim.level import load_level
from imagine.sim.radio import RadioMedium, RadioSettings
from imagine.sim.twin import Twin

_TWIN_DEADLINE_S = 300.0


def compile_kernels(settings: DroneSettings, on_start: Callable[[], None]) -> None:
    """Compile all that a simulated flight runs, unless an earlier start has; `on_start` is called where it has not."""
    marker = Path(os.environ["NUMBA_CACHE_DIR"]) / "flight-kernels"
    if marker.exists():
        return
    on_start()
    from imagine.onboard.build import warm_up

    twin = subprocess.Popen([sys.executable, "-m", "imagine.first_start"], stdin=subprocess.DEVNULL)
    try:
        warm_up(settings, None)
        twin.wait(_TWIN_DEADLINE_S)
    except subprocess.TimeoutExpired:
        return  # the flight then compiles for itself
    finally:
        if twin.poll() is None:
            twin.kill()
            twin.wait()
    try:
        marker.touch()
    except OSError:
        return  # without a cache everybody compiles for himself


def warm_twin() -> None:
    """Run a small twin through one tick: its kernels are loaded, or compiled, before a flight's first tick is due."""
    level = load_level("3")
    twin = Twin([level], drones=2)
    scans = twin.scan()[0]
    Coverage(level, 2, twin.lidar, range_cap_m=4.0).update(twin.poses[0], scans)
    RadioMedium(2, RadioSettings(), np.random.default_rng(0), level.segments).in_reach(twin.poses[0])
    twin.step(np.zeros((1, 2, 3)))


if __name__ == "__main__":
    warm_twin()
