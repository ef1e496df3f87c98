"""The policy contract: what a model needs and gives, carried as JSON inside the ONNX file.

`onboard` builds its pipeline from it and refuses a model whose contract it cannot honour.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from imagine.core.config import Settings, check_settings
from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec
from imagine.core.mapping import MapSettings
from imagine.core.observation_spec import ObservationSpec
from imagine.core.vehicle_limits import VehicleLimits

CONTRACT_KEY = "imagine.contract"
"""Key of the contract among the ONNX file's metadata properties."""
STATE, NEXT_STATE = "state", "next_state"
"""Names of the input and the output by which a model remembers, `[batch, state_size]`."""
LEVEL = "level"
"""Name of the input that shows a centralised policy the whole level, `[batch, *level_shape]`."""

Paradigm = Literal["ctde", "dtde", "ctce"]
"""Who sees what: centralised (C) or decentralised (D) training (T) and execution (E)."""


class ActionSpec(Settings):
    """What the model's output means: numbers in [-1, 1], scaled by the limits.

    `plane`: (vx, vy) along the observation's axes, no rotation; vectors longer than 1 are shortened to 1, so that the
    direction is kept. `body`: (vx forward, vy left, yaw rate). `forward`: (speed forward, yaw rate), where a negative
    speed is none, so that standing and turning on the spot is a whole half of the range and not a single number.
    `waypoint`: a point to fly to, `waypoint_range_m` times the vector (shortened as in `plane`) from where the drone
    is, along the observation's axes, without rotation, at a speed from which the drone can stop there.

    A decision stands for `decision_ticks` ticks; a waypoint then stays where it is in the map.
    """

    mode: Literal["plane", "body", "forward", "waypoint"] = "plane"
    speed_mps: float = Field(default=0.8, gt=0.0)
    yaw_rate_rps: float = Field(default=3.0, gt=0.0)
    waypoint_range_m: float = Field(default=2.0, gt=0.0, le=20.0, description="distance of the farthest waypoint")
    waypoint_braking_mps2: float = Field(default=1.0, gt=0.0, description="deceleration it is approached with")
    waypoint_response_s: float = Field(
        default=0.4, gt=0.0, le=5.0, description="from setpoint to velocity, reaction included; also the last approach"
    )
    decision_ticks: int = Field(default=1, ge=1, le=100, description="ticks of the LiDAR that a decision stands for")

    @property
    def size(self) -> int:
        """Numbers in an action."""
        return 3 if self.mode == "body" else 2

    @property
    def turns(self) -> bool:
        """Whether the model commands a yaw rate."""
        return self.mode in ("body", "forward")


class LidarContract(Settings):
    """The LiDAR a policy was trained with; fields as in `LidarSpec`."""

    beams: int
    fov: float
    range_min: float
    range_max: float
    rate_hz: float
    noise_std: float
    start: float

    @staticmethod
    def of(spec: LidarSpec) -> LidarContract:
        """Record a sensor."""
        return LidarContract(**dataclasses.asdict(spec))

    def spec(self) -> LidarSpec:
        """Return the sensor."""
        return LidarSpec(**self.model_dump())


class PolicyContract(Settings):
    """Everything a runner must match to fly a model as it was trained.

    A model that remembers takes `state`, zero where a flight begins, and gives `next_state` for its next decision. One
    of the paradigm `ctce` decides for a whole team at once, by what all its drones see and by the whole level: its
    batch is the team, and no drone can fly it. Both are of version 2.
    """

    contract_version: Literal[1, 2] = Field(default=1, description="2 with a state or for ctce; may be left out")
    name: str = Field(min_length=1, max_length=100)
    observation: ObservationSpec
    action: ActionSpec
    rate_hz: float = Field(gt=0.0, le=100.0)
    lidar: LidarContract
    map: MapSettings
    limits: VehicleLimits
    paradigm: Paradigm = "ctde"
    state_size: int = Field(default=0, ge=0, le=10_000_000, description="numbers the model remembers; 0: none")
    level_shape: tuple[int, int, int] | None = Field(default=None, description="of the level's image, for ctce")
    training: dict[str, Any] = Field(default_factory=dict, description="run, config, steps and result, for the record")
    weights_sha256: str = Field(default="", description="hash of the model's initialisers, in order of name")

    @model_validator(mode="before")
    @classmethod
    def _version_of_its_needs(cls, data: Any) -> Any:
        if isinstance(data, dict) and "contract_version" not in data:
            return {**data, "contract_version": 2 if data.get("state_size") or data.get("paradigm") == "ctce" else 1}
        return data

    @model_validator(mode="after")
    def _needs_fit(self) -> Self:
        if self.contract_version == 1 and (self.state_size or self.paradigm == "ctce"):
            raise ValueError("version 1 knows neither a state nor ctce: say contract_version 2, or leave it out")
        if (self.paradigm == "ctce") != (self.level_shape is not None):
            raise ValueError("level_shape is for the paradigm ctce, which needs it")
        return self

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """Shape of each input of the model, by name, without the batch axis."""
        shapes = dict(self.observation.shapes)
        if self.level_shape is not None:
            shapes[LEVEL] = self.level_shape
        if self.state_size:
            shapes[STATE] = (self.state_size,)
        return shapes

    def to_json(self) -> str:
        """Return the contract as the JSON text that the ONNX file carries."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True)

    @staticmethod
    def from_json(text: str, where: str) -> PolicyContract:
        """Read a contract; `where` names the model in errors. Raises InputError naming the field that does not fit."""
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:  # broken, or numbers or nesting past all measure
            place = f" (character {error.pos})" if isinstance(error, json.JSONDecodeError) else ""
            raise InputError(f"{where}: its contract is not valid JSON{place}") from error
        if not isinstance(data, dict):
            raise InputError(f"{where}: its contract is not a JSON object")
        return check_settings(PolicyContract, data, where=f"{where}: contract")
