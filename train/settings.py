"""All settings of a training run, as its YAML file holds them."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from imagine.core.config import Settings, load_settings
from imagine.core.errors import InputError
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.curriculum_settings import CurriculumSettings
from imagine.train.imitation import ImitationSettings
from imagine.train.networks import DeviceName, NetworkSettings, steers
from imagine.train.ppo_settings import PpoSettings
from imagine.train.rehearsal import RehearsalSettings
from imagine.train.tracking.settings import TrackingSettings

CONFIGS = Path(__file__).parent / "configs"
"""Folder of the configurations that come with the package, such as `default.yaml`."""


class RunSettings(Settings):
    """What a run is called, where it is kept, and how often it is saved."""

    name: str = Field(default="default", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)
    root: str = Field(default="runs", description="folder of run folders")
    seed: int = Field(default=0, ge=0)
    device: DeviceName = Field(default="auto", description="of networks and rollouts; auto: CUDA where there is one")
    threads: int | None = Field(default=None, ge=1, description="of torch; none: one for each core")
    rollout_workers: int = Field(default=0, ge=0, description="of Ray, which share the worlds; 0: this process flies")
    checkpoint_every_s: float = Field(default=60.0, gt=0.0)
    keep_checkpoints: int = Field(default=3, ge=1, description="numbered checkpoints kept beside the latest")
    final_episodes: int = Field(default=8, ge=0, description="evaluated on each level at the end; 0: none")


class TrainSettings(Settings):
    """A training run: environment, curriculum, networks, imitation, PPO, rehearsal, tracking."""

    run: RunSettings = Field(default_factory=RunSettings)
    env: ExplorationSettings = Field(default_factory=ExplorationSettings)
    curriculum: CurriculumSettings = Field(default_factory=CurriculumSettings)
    network: NetworkSettings = Field(default_factory=NetworkSettings)
    imitation: ImitationSettings = Field(default_factory=ImitationSettings)
    ppo: PpoSettings = Field(default_factory=PpoSettings)
    rehearsal: RehearsalSettings = Field(default_factory=RehearsalSettings)
    tracking: TrackingSettings = Field(default_factory=TrackingSettings)

    @property
    def practice(self) -> ExplorationSettings:
        """What imitation and PPO fly in: `env`, where decisions stand for `ppo.decision_ticks`."""
        ticks = self.ppo.decision_ticks or self.env.action.decision_ticks
        action = self.env.action.model_copy(update={"decision_ticks": ticks})
        return self.env.model_copy(update={"action": action})

    @property
    def practice_momentum(self) -> float:
        """What holds a drone to its choice in imitation and PPO."""
        told = self.ppo.choice_momentum
        return self.network.choice_momentum if told is None else told

    @model_validator(mode="after")
    def _memories_count_the_same_decisions(self) -> Self:
        learned, flown = self.practice.action.decision_ticks, self.env.action.decision_ticks
        if self.network.memory != "none" and learned != flown:
            raise ValueError(
                f"ppo.decision_ticks {learned} is not env.action.decision_ticks, {flown}: a memory counts in "
                "decisions; set ppo.decision_ticks to null, and env.action.decision_ticks to what is wanted"
            )
        return self

    @model_validator(mode="after")
    def _choice_has_choices(self) -> Self:
        observation, action = self.env.observation, self.env.action
        if self.network.head == "choice" and not (observation.frontiers and steers(observation, action)):
            raise ValueError(
                "network.head choice needs env.observation.frontiers above 0, and actions that are a direction along "
                "the observation's axes: env.action.mode plane or waypoint; else take network.head gaussian"
            )
        return self


def load_train_settings(config: Path | None, overrides: tuple[str, ...] = ()) -> TrainSettings:
    """Read a training configuration: a YAML file, the name of a packaged one (`smoke`), or None (`default`).

    Raises InputError with file, line and key.
    """
    path = config or CONFIGS / "default.yaml"
    packaged = CONFIGS / f"{path.name}.yaml"
    if not path.exists() and path.parent == Path() and packaged.exists():
        path = packaged
    if not path.exists() and path.parent == Path():
        names = ", ".join(sorted(file.stem for file in CONFIGS.glob("*.yaml")))
        raise InputError(f"{path}: no such file, and no packaged configuration; these are {names}")
    return load_settings(TrainSettings, path, overrides)
