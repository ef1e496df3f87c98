"""Ends a study whose cluster is gone, where Ray would wait."""

from __future__ import annotations

import _thread
import signal
import threading
import time

from imagine.train.study.cluster import reachable
from imagine.train.study.tune_events import Events

_LOOK_EVERY_S = 5.0
_GIVE_UP_S = 20.0
_SPARE_S = 300.0  # beside the trials' own watchdogs, for workers to start anew


class LostCluster:
    """While entered, interrupts the main thread when the head stops answering or nothing happens any more.

    `reason` then says which, and is empty otherwise. Does nothing when entered outside the main thread, where Tune
    could not be interrupted.
    """

    def __init__(self, address: str | None, events: Events, silent_s: float) -> None:
        self.reason = ""
        self._address, self._events = address, events
        self._silent_s = silent_s + _SPARE_S
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="lost-cluster", daemon=True)
        self._active = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> LostCluster:
        """Begin to watch."""
        if self._active:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End watching."""
        self._over.set()
        if self._active:
            self._thread.join(2.0 * _LOOK_EVERY_S)

    def _watch(self) -> None:
        answered = time.monotonic()
        while not self._over.wait(_LOOK_EVERY_S):
            now = time.monotonic()
            if self._address is None or reachable(self._address, _LOOK_EVERY_S):
                answered = now
            if now - answered >= _GIVE_UP_S:
                self.reason = f"the cluster at {self._address} is lost: its head answers no more"
            elif now - self._events.newest >= self._silent_s:
                self.reason = f"nothing happened to any trial for {self._silent_s:.0f} s"
            if self.reason:
                _thread.interrupt_main(signal.SIGINT)
                return
