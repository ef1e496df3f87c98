"""Ends a study whose cluster is gone, where Ray would wait."""

from __future__ import annotations

import _thread
import logging
import os
import signal
import threading
import time

from imagine.core.errors import WorkError
from imagine.train.study.cluster import reachable
from imagine.train.study.tune_events import Events

logger = logging.getLogger(__name__)

_LOOK_EVERY_S = 3.0
_GIVE_UP_S = 15.0
_END_S = 10.0
_SPARE_S = 300.0  # beside the trials' own watchdogs, for workers to start anew


class LostCluster:
    """While entered, interrupts the main thread when the head stops answering or nothing happens any more.

    `reason` then says which, and is empty otherwise. Where even that does not end Tune, since it waits inside Ray for a
    head that is gone, the process ends: Ray would end it too, half a minute later and without a word of what to do, and
    nothing is lost, for a study goes on from its run folders. Does nothing when entered outside the main thread, where
    Tune could not be interrupted.
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
                if not self._over.wait(_END_S):
                    logger.critical("%s; go on with --resume", self.reason)
                    os._exit(WorkError.exit_status)
                return
