"""What can be set about exploration in the twin."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from pydantic import Field, field_validator

from imagine.core.config import Settings
from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError
from imagine.core.lidar import PRESETS, LidarSpec
from imagine.core.mapping import MapSettings
from imagine.core.observation_spec import ObservationSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.mesh_comm.settings import MeshSettings, Protocol
from imagine.sim.dynamics import DynamicsSettings
from imagine.sim.level_names import expand_level
from imagine.sim.lidar_model import LidarModel
from imagine.sim.odometry_drift import DriftSettings
from imagine.sim.radio import RadioSettings
from imagine.sim.randomisation import Quantity, ends, positive
from imagine.sim.reward import RewardSettings


class ExplorationSettings(Settings):
    """What is explored, by whom, and what a policy sees and does."""

    levels: tuple[str, ...] = Field(
        default=("0", "1", "2", "3", "4", "5", "6"), min_length=1,
        description="names of levels, also ranges: 0-6, house:0-99, house:0-99:50-200 (areas in m²)",
    )  # fmt: skip
    level_weights: tuple[float, ...] | None = Field(
        default=None, description="share of episodes of each of levels; what a range stands for shares it equally"
    )
    worlds: int = Field(default=24, ge=1, le=4096)
    drones: int = Field(default=3, ge=1, le=16)
    episode_ticks: int = Field(default=1000, ge=1)
    stop_coverage: float = Field(default=0.995, gt=0.0, le=1.0, description="an episode ends when so much is covered")
    random_launch: bool = Field(default=True, description="start anywhere, not at the level's launch point")
    mirror: bool = Field(default=True, description="show levels mirrored and turned as well")
    as_designed: float = Field(
        default=0.0, ge=0.0, le=1.0,
        description="share of episodes in the level as it is, from its own launch point, whatever the two above say",
    )  # fmt: skip
    stagger: bool = Field(default=False, description="give first episodes different lengths, so resets spread out")
    lidar: str = "ld19"
    lidar_beams: int | None = Field(
        default=None, ge=4, le=4096, description="the same sensor with so many beams; by default its own"
    )
    map: MapSettings = MapSettings()
    limits: VehicleLimits = VehicleLimits()
    observation: ObservationSpec = ObservationSpec()
    action: ActionSpec = ActionSpec()
    protocol: Protocol = "one-hop"
    budget_bytes_per_s: Annotated[Quantity, positive()] = Field(
        default=MeshSettings().rate_bytes_per_s, description="bytes a second that a drone may send, sealed"
    )
    radio: RadioSettings = RadioSettings()
    reward: RewardSettings = RewardSettings()
    dynamics: DynamicsSettings = DynamicsSettings()
    sensing: LidarModel = LidarModel()
    drift: DriftSettings = DriftSettings()

    @field_validator("levels")
    @classmethod
    def _known_ranges(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            try:
                expand_level(name, "level")
            except InputError as error:
                raise ValueError(str(error)) from error
        return names

    @field_validator("lidar")
    @classmethod
    def _known_lidar(cls, name: str) -> str:
        if name not in PRESETS:
            raise ValueError(f"unknown LiDAR; known: {', '.join(PRESETS)}")
        return name

    @property
    def lidar_spec(self) -> LidarSpec:
        """The sensor that is explored with: the preset, with `lidar_beams` spread over its field of view."""
        preset = PRESETS[self.lidar]
        return preset if self.lidar_beams is None else dataclasses.replace(preset, beams=self.lidar_beams)

    @property
    def mesh(self) -> MeshSettings:
        """How the drones use their radios, with the largest budget that an episode may have."""
        return MeshSettings(protocol=self.protocol, rate_bytes_per_s=ends(self.budget_bytes_per_s)[1])
