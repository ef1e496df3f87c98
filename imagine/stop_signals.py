"""Ctrl-C, SIGTERM or a closed terminal in flight: the first lands the drones, the second ends the command at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignals:
    """While entered, turns the signals into KeyboardInterrupt until `flying` is set, then into `requested`.

    Before takeoff there is nothing to land; in flight the first signal only sets `requested`, a second interrupts.
    """

    def __init__(self) -> None:
        """Take no signals yet."""
        self.flying = False
        self.requested = False
        self._before: dict[signal.Signals, Callable[..., Any] | int | None] = {}

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.requested or not self.flying:
            raise KeyboardInterrupt
        self.requested = True

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():  # no other thread gets signals
            self._before = {n: signal.signal(n, self._take) for n in _SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
