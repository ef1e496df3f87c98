"""Hears what Tune says of its trials. Imports Ray, and so only after `cluster.ray_connection` has set it up."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from ray.tune.progress_reporter import TrialProgressCallback

from imagine.train.study.events import Event, Kind, Tell

_NUMBERS: tuple[str, ...] = ("agent_steps", "coverage", "t90", "contacts")


class Events(TrialProgressCallback):
    """Hears Tune's calls and passes them on; `close(trial, error)` is called when Tune has ended one.

    It stands in for the callback of this class that Tune would add by itself, and that prints.
    """

    def __init__(self, tell: Tell, close: Callable[[str, str | None], None]) -> None:
        self._tell, self._close = tell, close
        self.newest = time.monotonic()
        """When something happened last, by the monotonic clock."""

    def _pass(self, trial: Any, kind: Kind, result: dict[str, Any] | None = None, error: str = "") -> None:
        self.newest = time.monotonic()
        told = result or {}
        numbers: dict[str, float] = {name: float(told[name]) for name in _NUMBERS if name in told}
        name = str(trial.config["task"]["name"])
        self._tell(Event(name, kind, numbers, told.get("pid"), str(told.get("hostname", "")), error))

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Tell that a worker took a trial up."""
        self._pass(trial, "started")

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        """Tell what a trial reports."""
        self._pass(trial, "reported", result)

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Tell that a trial ended, by itself or stopped by ASHA."""
        self._close(str(trial.config["task"]["name"]), None)
        self._pass(trial, "ended", trial.last_result)

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Tell that a trial whose worker died will be taken up again."""
        self._pass(trial, "taken up again", trial.last_result)

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Tell that a trial is given up."""
        error = trial.get_error() or "its worker died"
        line = str(error).strip().splitlines()[-1]
        self._close(str(trial.config["task"]["name"]), line)
        self._pass(trial, "failed", trial.last_result, line)
