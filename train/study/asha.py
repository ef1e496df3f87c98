"""Tune's ASHA, which lets a trial that has trained to its end be evaluated. Imports Ray, as `tune_events` does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ray.tune.schedulers import ASHAScheduler, TrialScheduler

from imagine.train.study.settings import StudySettings


class Asha(ASHAScheduler):
    """Stops trials at milestones, but none that has made all its agent-steps, `totals` by the trial's name."""

    def __init__(self, study: StudySettings, totals: Mapping[str, int]) -> None:
        longest = max(totals.values())
        super().__init__(
            time_attr="agent_steps",
            metric=study.metric,
            mode=study.better,
            grace_period=min(study.asha.grace_agent_steps, longest),
            reduction_factor=study.asha.reduction_factor,
            max_t=int(longest * max(2.0, study.asha.reduction_factor)),  # Tune stops a trial that reports it
        )
        self._totals = totals

    def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> str:
        """Return whether the trial goes on."""
        decision = super().on_trial_result(tune_controller, trial, result)
        done = result.get("agent_steps", 0) >= self._totals[trial.config["task"]["name"]]
        return str(TrialScheduler.CONTINUE if done else decision)
