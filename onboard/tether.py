"""A drone's process on the tether of the program that started it: told when to begin, and ended when that one goes.

A pipe on standard input carries both: a line says that the settings are written, its end that nobody is left who
would end the flight. The pipe closes however the other program dies, by SIGKILL too.
"""

from __future__ import annotations

import os
import signal
import sys
import threading


def load_code() -> None:
    """Import what a flight will need, while the settings are still being made."""
    import onnxruntime  # noqa: F401

    import imagine.onboard.lidar_udp
    import imagine.onboard.mavlink
    import imagine.onboard.process  # noqa: F401


def wait_for_settings() -> bool:
    """Wait for the line that says the settings are written; False where standard input ended instead."""
    return bool(sys.stdin.readline())


def end_with_standard_input() -> None:
    """From now on ask this process to land and end, by SIGTERM, once standard input ends."""

    def watch() -> None:
        while os.read(0, 4096):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="tether", daemon=True).start()
