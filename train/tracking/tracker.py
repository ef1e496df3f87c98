"""The port that scalars of a run leave by, and several of them as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Protocol


class Tracker(Protocol):
    """Whoever keeps the scalars of a run.

    Files that cannot be written raise WorkError, which ends the run; a server that cannot be reached never does.
    """

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Take the scalars of one update, made after `step` agent-steps."""

    def config(self, config: Mapping[str, Any]) -> None:
        """Take the settings of the run, plain values in nested mappings."""

    def close(self) -> None:
        """Hand over what is still to be handed over, within a deadline; nothing is taken after that."""


class Trackers:
    """Several trackers as one: each is told everything, in their order."""

    def __init__(self, trackers: Sequence[Tracker]) -> None:
        self._trackers = tuple(trackers)

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Tell all of them. Raises WorkError of the first that cannot write."""
        for tracker in self._trackers:
            tracker.log(step, scalars)

    def config(self, config: Mapping[str, Any]) -> None:
        """Tell all of them. Raises WorkError of the first that cannot write."""
        for tracker in self._trackers:
            tracker.config(config)

    def close(self) -> None:
        """Close all of them, also where one fails to."""
        with ExitStack() as stack:
            for tracker in reversed(self._trackers):
                stack.callback(tracker.close)
