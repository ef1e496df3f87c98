"""How a PX4-class autopilot decides: modes, arming, the offboard rule, failsafes and height. No MAVLink in here.

The rules are those measured on PX4 1.16 flying without GPS: OFFBOARD needs a running stream of setpoints, arming needs
a position, and whatever stops feeding the vehicle makes it land by itself.
"""

from __future__ import annotations

import math
from enum import Enum, IntEnum
from typing import NamedTuple

from pydantic import Field

from imagine.core.config import Settings


class Mode(Enum):
    """PX4 flight modes the vehicle knows, as (main mode, sub mode) of HEARTBEAT.custom_mode."""

    HOLD = (4, 3)
    TAKEOFF = (4, 2)
    LAND = (4, 6)
    OFFBOARD = (6, 0)

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode: main mode in bits 16-23, sub mode in bits 24-31."""
        main, sub = self.value
        return int(main << 16 | sub << 24)


class Result(IntEnum):
    """Answer to a command, with the numbers of MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3


class Failsafe(NamedTuple):
    """The vehicle took over by itself: when (simulated seconds) and why."""

    time_s: float
    reason: str


class Setpoint(NamedTuple):
    """A velocity command: horizontal m/s in the body frame (FLU) or the map frame, climb m/s, and yaw or its rate."""

    vx: float
    vy: float
    climb: float
    yaw_rate: float
    yaw: float | None
    in_body: bool


class VehicleSettings(Settings):
    """A PX4-like vehicle: failsafe delays in seconds, speeds in m/s, sensor errors as standard deviations."""

    offboard_loss_s: float = Field(default=1.0, gt=0.0, le=10.0, description="silence until it lands (COM_OF_LOSS_T)")
    odometry_hold_s: float = Field(default=1.0, gt=0.0, le=10.0, description="odometry age until it is not trusted")
    odometry_land_s: float = Field(default=5.0, gt=0.0, le=60.0, description="odometry age until it lands")
    takeoff_height_m: float = Field(default=1.0, gt=0.1, le=10.0, description="height of AUTO.TAKEOFF")
    ceiling_m: float = Field(default=2.4, gt=0.2, le=100.0, description="height it cannot climb above")
    climb_mps: float = Field(default=0.8, gt=0.0, le=5.0, description="greatest vertical speed")
    land_mps: float = Field(default=0.4, gt=0.0, le=5.0, description="descent of AUTO.LAND")
    endurance_s: float = Field(default=780.0, gt=0.0, description="flying time from full to empty")
    battery_land: float = Field(default=0.05, ge=0.0, lt=1.0, description="charge, 0..1, below which it lands")
    gyro_bias_std_rps: float = Field(default=0.002, ge=0.0, le=0.5, description="constant error of the yaw gyro")
    gyro_noise_std_rps: float = Field(default=0.005, ge=0.0, le=0.5, description="white error of the yaw gyro")
    height_noise_std_m: float = Field(default=0.01, ge=0.0, le=0.5, description="white error of the height")
    wind_mps: tuple[float, float] = Field(default=(0.0, 0.0), description="drift in the map frame, without odometry")


GROUND_M = 0.05
"""Below this height the vehicle counts as on the ground."""
AIRBORNE_M = 0.1
"""Below this height friction holds it: it moves neither sideways nor around."""
_CLIMB_ACCELERATION = 2.0
_STREAM_GAP_S = 0.5  # PX4 asks for setpoints at 2 Hz or more ...
_STREAM_S = 1.0  # ... for a second before it lets OFFBOARD in
_DISARM_AFTER_FLIGHT_S = 2.0  # COM_DISARM_LAND
_DISARM_WITHOUT_FLIGHT_S = 10.0  # COM_DISARM_PRFLT
_DISARM_AFTER_LAND_S = 0.5
_IDLE_DRAIN = 0.1  # share of the flying current that the electronics draw on the ground
_EPSILON_S = 1e-6
STREAM_LOST, ODOMETRY_LOST, BATTERY_LOW = "offboard stream lost", "odometry lost", "battery low"


class FlightControl:
    """Mode, arming, setpoint stream, failsafes, height and battery of one vehicle; time comes in with every call."""

    def __init__(self, settings: VehicleSettings) -> None:
        """Stand on the ground, disarmed, in HOLD, with a full battery."""
        self.settings = settings
        self.mode = Mode.HOLD
        self.armed = False
        self.height_m = 0.0
        self.climb_mps = 0.0
        self.battery = 1.0
        self.offboard_loss_s = settings.offboard_loss_s
        self.takeoff_height_m = settings.takeoff_height_m
        self.setpoint: Setpoint | None = None
        self.failsafes: list[Failsafe] = []
        self.notices: list[str] = []
        self._target_height_m = settings.takeoff_height_m
        self._stream_since = -math.inf
        self._setpoint_at = -math.inf
        self._fused_at = -math.inf
        self._grounded_since = 0.0
        self._has_flown = False
        self._resumes_offboard = False
        self._distrust_said = False

    @property
    def landed(self) -> bool:
        """Whether it stands on the ground."""
        return self.height_m < GROUND_M

    @property
    def airborne(self) -> bool:
        """Whether it is armed and high enough to move sideways."""
        return self.armed and self.height_m >= AIRBORNE_M

    @property
    def in_failsafe(self) -> bool:
        """Whether it lands because it decided to, not because it was told to."""
        return bool(self.failsafes) and self.armed and self.mode is Mode.LAND

    def take_setpoint(self, setpoint: Setpoint, now: float) -> None:
        """Follow this velocity when in OFFBOARD, and count it into the stream that OFFBOARD needs."""
        if now - self._setpoint_at > _STREAM_GAP_S + _EPSILON_S:
            self._stream_since = now
        self._setpoint_at = now
        self.setpoint = setpoint

    def take_position(self, now: float) -> None:
        """Note that external odometry was fused."""
        self._fused_at = now
        self._distrust_said = False

    def has_position(self, now: float) -> bool:
        """Whether the odometry is fresh enough to be trusted."""
        return now - self._fused_at <= self.settings.odometry_hold_s + _EPSILON_S

    def has_stream(self, now: float) -> bool:
        """Whether setpoints have come at 2 Hz or more for at least a second, and still come."""
        running = now - self._setpoint_at <= _STREAM_GAP_S + _EPSILON_S
        return running and now - self._stream_since >= _STREAM_S - _EPSILON_S

    def can_arm(self, now: float) -> bool:
        """Whether arming would be allowed now."""
        return self.has_position(now) and self.mode is not Mode.LAND and self.battery > self.settings.battery_land

    def arm(self, now: float, force: bool = False) -> Result:
        """Start the motors."""
        if self.armed:
            return Result.ACCEPTED
        if not force and not self.can_arm(now):
            missing = "no position estimate" if not self.has_position(now) else "mode or battery"
            self.notices.append(f"Arming denied: {missing}")
            return Result.TEMPORARILY_REJECTED
        self.armed, self._has_flown, self._grounded_since = True, False, now
        self.notices.append("Armed")
        return Result.ACCEPTED

    def disarm(self, force: bool = False) -> Result:
        """Stop the motors; in the air only by force, and then it falls."""
        if self.armed and not self.landed and not force:
            self.notices.append("Disarming denied: not landed")
            return Result.TEMPORARILY_REJECTED
        if self.armed:
            self.notices.append("Disarmed")
        self.armed, self._resumes_offboard, self.climb_mps = False, False, 0.0
        if self.mode in (Mode.LAND, Mode.TAKEOFF):
            self.mode = Mode.HOLD
        return Result.ACCEPTED

    def take_off(self, height_m: float, now: float) -> Result:
        """Climb to a height above the ground and hold there; not a number: to the takeoff height."""
        if not self.has_position(now):
            self.notices.append("Takeoff denied: no position estimate")
            return Result.TEMPORARILY_REJECTED
        wanted = height_m if math.isfinite(height_m) and height_m > 0.0 else self.takeoff_height_m
        self._target_height_m = min(wanted, self.settings.ceiling_m)
        self.mode, self._resumes_offboard = Mode.TAKEOFF, False
        return Result.ACCEPTED

    def set_mode(self, mode: Mode, now: float) -> Result:
        """Change the mode. As on PX4, OFFBOARD without a stream is accepted and then not entered."""
        if mode is Mode.TAKEOFF:
            return self.take_off(math.nan, now)
        if mode is Mode.OFFBOARD and not (self.has_stream(now) and self.has_position(now)):
            self.notices.append("Offboard not entered: no setpoint stream or position")
            return Result.ACCEPTED
        self.mode, self._resumes_offboard = mode, False
        return Result.ACCEPTED

    def update(self, now: float, dt: float) -> None:
        """Advance failsafes, height, ground contact and battery by `dt` seconds, to the time `now`."""
        self._check_failsafes(now)
        self._advance_height(dt)
        self._check_ground(now)
        drain = (1.0 if self.armed and not self.landed else _IDLE_DRAIN) * dt / self.settings.endurance_s
        self.battery = max(0.0, self.battery - drain)

    def _check_failsafes(self, now: float) -> None:
        silent = now - self._setpoint_at >= self.offboard_loss_s - _EPSILON_S
        if not self.armed:
            if self.mode is Mode.OFFBOARD and silent:
                self.mode = Mode.HOLD
            return
        if self.mode is Mode.OFFBOARD and silent:
            self._fail(STREAM_LOST, now)
            self._resumes_offboard = True
        elif self._resumes_offboard and self.has_stream(now) and self.has_position(now):
            self.mode, self._resumes_offboard = Mode.OFFBOARD, False
            self.notices.append("Offboard stream regained")
        if not self.has_position(now) and not self._distrust_said:
            self._distrust_said = True
            self.notices.append("No position: holding")
        if self.mode is not Mode.LAND and now - self._fused_at >= self.settings.odometry_land_s - _EPSILON_S:
            self._fail(ODOMETRY_LOST, now)
        if self.mode is not Mode.LAND and self.battery < self.settings.battery_land:
            self._fail(BATTERY_LOW, now)

    def _fail(self, reason: str, now: float) -> None:
        self.mode, self._resumes_offboard = Mode.LAND, False
        self.failsafes.append(Failsafe(now, reason))
        self.notices.append(f"Failsafe: {reason}, landing")

    def _advance_height(self, dt: float) -> None:
        if not self.armed:
            self.climb_mps = -3.0 if self.height_m > 0.0 else 0.0  # motors off: it falls
        else:
            wanted = max(-self.settings.climb_mps, min(self.settings.climb_mps, self._wanted_climb()))
            change = _CLIMB_ACCELERATION * dt
            self.climb_mps += max(-change, min(change, wanted - self.climb_mps))
        height = self.height_m + self.climb_mps * dt
        self.height_m = max(0.0, min(self.settings.ceiling_m, height))
        if self.height_m != height:
            self.climb_mps = 0.0

    def _wanted_climb(self) -> float:
        if self.mode is Mode.TAKEOFF:
            return 1.5 * (self._target_height_m - self.height_m)
        if self.mode is Mode.LAND:
            return -self.settings.land_mps
        if self.mode is Mode.OFFBOARD and self.setpoint is not None:
            return self.setpoint.climb
        return 0.0

    def _check_ground(self, now: float) -> None:
        if self.mode is Mode.TAKEOFF and self.armed and self.height_m > self._target_height_m - 0.05:
            self.mode = Mode.HOLD
        if not self.landed:
            self._grounded_since, self._has_flown = now, True
            return
        if self.mode is Mode.LAND:
            patience_s = _DISARM_AFTER_LAND_S
        else:
            patience_s = _DISARM_AFTER_FLIGHT_S if self._has_flown else _DISARM_WITHOUT_FLIGHT_S
        if self.armed and now - self._grounded_since >= patience_s - _EPSILON_S:
            self.disarm()
