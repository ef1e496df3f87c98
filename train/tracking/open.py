"""The trackers that a run's settings ask for."""

from __future__ import annotations

from pathlib import Path

from imagine.train.tracking.json_lines import JsonLinesTracker
from imagine.train.tracking.settings import TrackingSettings
from imagine.train.tracking.tensorboard_events import TensorBoardTracker
from imagine.train.tracking.tracker import Tracker, Trackers
from imagine.train.tracking.wandb_run import WandbTracker, check_wandb


def check_tracking(settings: TrackingSettings) -> None:
    """Check, before anything is written, that all trackers can be had. Raises InputError with the remedy."""
    check_wandb(settings.wandb)


def open_trackers(settings: TrackingSettings, folder: Path, name: str, start_step: int = 0) -> Trackers:
    """Open a run's trackers; files go into its `folder`. A run that goes on does so after `start_step` agent-steps.

    Raises WorkError when a file cannot be written.
    """
    trackers: list[Tracker] = [JsonLinesTracker(folder / "metrics.jsonl")]
    if settings.tensorboard:
        trackers.append(TensorBoardTracker(folder / "tensorboard", start_step))
    if settings.wandb.mode != "off":
        trackers.append(WandbTracker(settings.wandb, folder, name))
    return Trackers(trackers)
