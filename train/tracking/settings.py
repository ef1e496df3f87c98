"""Settings of where the scalars of a run go."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from imagine.core.config import Settings


class WandbSettings(Settings):
    """Weights & Biases: off, into the run folder for a later `wandb sync`, or to the server while training goes on."""

    mode: Literal["off", "offline", "online"] = "off"
    project: str = Field(default="imagine", min_length=1)
    entity: str | None = Field(default=None, description="user or team; none: whoever is logged in")
    group: str | None = Field(default=None, description="runs shown together")
    tags: tuple[str, ...] = ()


class TrackingSettings(Settings):
    """Who is told the scalars of every update. The file `metrics.jsonl` is always written."""

    tensorboard: bool = True
    wandb: WandbSettings = Field(default_factory=WandbSettings)
