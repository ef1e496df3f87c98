"""The plain records that flow through the runner: what a tick is given and what it gives back.

Map frame: x east, y north, yaw counter-clockwise from x. Body frame FLU: x forward, y left, z up. SI units; stamps in
seconds of the runner's clock (simulated in lockstep).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from imagine.core.frames import Pose
from imagine.core.lidar import Scan


class FlightMode(StrEnum):
    """The autopilot's mode, as far as the runner tells modes apart."""

    OFFBOARD = "OFFBOARD"
    HOLD = "HOLD"
    LAND = "LAND"
    POSITION = "POSITION"
    MANUAL = "MANUAL"
    OTHER = "OTHER"


class VehicleCommand(StrEnum):
    """What the runner can ask of the autopilot besides velocity; asking is not having, telemetry tells."""

    OFFBOARD = "offboard"
    ARM = "arm"
    DISARM = "disarm"
    LAND = "land"


@dataclass(frozen=True)
class Ack:
    """The autopilot's answer to a command: `result` in the words of MAV_RESULT, such as TEMPORARILY_REJECTED."""

    command: VehicleCommand
    accepted: bool
    result: str


@dataclass(frozen=True)
class Telemetry:
    """The newest of everything the autopilot says, heights in metres above where it was armed.

    `battery` is in 0..1, None where unknown. `position_ok`: its estimator has a local position. `texts` and `acks` are
    those that came since the telemetry before. `ranged`: the height is a rangefinder's, not the autopilot's own
    estimate; `height_age_s` grows from 0 once a rangefinder falls silent that had been heard.
    """

    stamp: float
    yaw: float = 0.0
    yaw_rate: float = 0.0
    height_m: float = 0.0
    ranged: bool = False
    height_age_s: float = 0.0
    climb_mps: float = 0.0
    battery: float | None = None
    armed: bool = False
    mode: FlightMode = FlightMode.OTHER
    landed: bool = True
    position_ok: bool = False
    texts: tuple[str, ...] = ()
    acks: tuple[Ack, ...] = ()


@dataclass(frozen=True)
class Setpoint:
    """A velocity wanted of the autopilot: body FLU, m/s, and yaw rate in rad/s, counter-clockwise."""

    vx: float = 0.0
    vy: float = 0.0
    vz: float = 0.0
    yaw_rate: float = 0.0


@dataclass(frozen=True)
class OdometryOut:
    """The runner's estimate for the autopilot: pose and height in the map frame, velocity in body FLU.

    Variances in m², rad², (m/s)²; `reset_counter` (0..255) rises when the pose jumps instead of moving.
    """

    stamp: float
    pose: Pose
    height_m: float
    velocity: tuple[float, float, float]
    yaw_rate: float
    position_variance: float
    height_variance: float
    yaw_variance: float
    velocity_variance: float
    reset_counter: int


@dataclass(frozen=True)
class Event:
    """Something worth telling; `kind` is phase, decision, failsafe, command, autopilot or error."""

    stamp: float
    kind: str
    text: str


@dataclass(frozen=True)
class RunnerStatus:
    """Where a drone stands, for pilot, peers and record.

    `decider` is the ladder's rung while exploring (policy, frontier, hold, land), else the flight's phase.
    """

    stamp: float
    phase: str
    decider: str
    reason: str
    mode: str
    armed: bool
    tracked: bool
    pose: Pose
    velocity: tuple[float, float]
    height_m: float
    battery: float | None


@dataclass(frozen=True)
class TickInput:
    """All that a tick may know: the time, a scan if a fresh one came, the newest telemetry, mesh datagrams.

    `ending`: the runner's process was asked to end, so the drone must come down.
    """

    now: float
    scan: Scan | None
    telemetry: Telemetry | None
    datagrams: tuple[bytes, ...] = ()
    ending: bool = False


@dataclass(frozen=True)
class TickOutput:
    """All that a tick does: no setpoint (silence) unless a fresh scan fed it."""

    setpoint: Setpoint | None
    odometry: OdometryOut | None
    datagrams: tuple[bytes, ...]
    commands: tuple[VehicleCommand, ...]
    status: RunnerStatus
    events: tuple[Event, ...]
