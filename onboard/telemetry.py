"""From MAVLink messages to one Telemetry record: the newest of each, in the project's frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from imagine.core import ned
from imagine.onboard.records import Ack, FlightMode, Telemetry, VehicleCommand

_FRESH_S = 1.0
_RANGEFINDER_FRESH_S = 0.5
_HEARTBEAT_FRESH_S = 2.5  # it comes once a second, and carries mode and armed
_SIGNAL_INVALID = 1  # DISTANCE_SENSOR.signal_quality; 0 is unknown
_TEXT_BYTES = 50
_MOST_TEXTS = 20

_PX4_MAIN_MODES = {
    1: FlightMode.MANUAL,
    2: FlightMode.MANUAL,
    3: FlightMode.POSITION,
    5: FlightMode.MANUAL,
    6: FlightMode.OFFBOARD,
    7: FlightMode.MANUAL,
}
_PX4_AUTO = 4
_PX4_AUTO_MODES = {3: FlightMode.HOLD, 6: FlightMode.LAND}


def px4_mode(custom_mode: int) -> FlightMode:
    """Return the mode in PX4's HEARTBEAT.custom_mode: main mode in bits 16-23, sub mode in bits 24-31."""
    main, sub = (custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF
    if main == _PX4_AUTO:
        return _PX4_AUTO_MODES.get(sub, FlightMode.OTHER)
    return _PX4_MAIN_MODES.get(main, FlightMode.OTHER)


MODE_READERS: dict[int, Callable[[int], FlightMode]] = {mavlink.MAV_AUTOPILOT_PX4: px4_mode}
"""How to read custom_mode, by MAV_AUTOPILOT: the place where another make of autopilot is added."""


class TelemetryAssembler:
    """Collects messages of one autopilot. `clock` gives the time of arrival; None: the vehicle's time is the clock."""

    def __init__(self, clock: Callable[[], float] | None) -> None:
        """Start without any telemetry."""
        self.attitude_time = -math.inf
        """Time of the newest ATTITUDE, seconds since the vehicle booted."""
        self._clock = clock
        self._stamp = -math.inf
        self._heard_heartbeat = self._beat_is_new = False
        self._beat_at = -math.inf
        self._yaw = self._yaw_rate = 0.0
        self._height = self._ground = self._climb = 0.0
        self._position_at = -math.inf
        self._range_m, self._range_at = 0.0, -math.inf
        self._has_range = False
        self._battery: float | None = None
        self._armed = False
        self._mode = FlightMode.OTHER
        self._landed: bool | None = None
        self._texts: list[str] = []
        self._chunks: dict[int, str] = {}
        self._acks: list[Ack] = []
        self._expected: dict[int, VehicleCommand] = {}
        self._readers: dict[str, Callable[[Any], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "ATTITUDE": self._on_attitude,
            "LOCAL_POSITION_NED": self._on_position,
            "DISTANCE_SENSOR": self._on_range,
            "SYS_STATUS": self._on_battery,
            "BATTERY_STATUS": self._on_battery,
            "EXTENDED_SYS_STATE": self._on_landed,
            "STATUSTEXT": self._on_text,
            "COMMAND_ACK": self._on_ack,
        }

    def expect_ack(self, number: int, command: VehicleCommand) -> None:
        """Remember which command the next COMMAND_ACK of this MAV_CMD answers."""
        self._expected[number] = command

    def feed(self, message: Any) -> None:
        """Take one message; those of no interest change nothing."""
        reader = self._readers.get(message.get_type())
        if reader is not None:
            reader(message)

    def take(self) -> Telemetry | None:
        """Return the newest telemetry, with the texts and acks since the last taking; None while too little is known.

        Height comes from the downward rangefinder once one is heard, else from the local position since arming. When
        a rangefinder falls silent in flight its last height stands, and ages: the local position has another zero.
        With the heartbeat silent the stamp stops too, for mode and armed are no longer known.
        """
        if not self._heard_heartbeat or math.isinf(self.attitude_time):
            return None
        texts, acks = tuple(self._texts), tuple(self._acks)
        self._texts, self._acks = [], []
        age = max(0.0, self.attitude_time - self._range_at) if self._has_range else 0.0
        return Telemetry(
            stamp=min(self._stamp, self._beat_at + _HEARTBEAT_FRESH_S),
            yaw=self._yaw,
            yaw_rate=self._yaw_rate,
            height_m=self._range_m if self._has_range else self._height - self._ground,
            ranged=self._has_range and age <= _RANGEFINDER_FRESH_S,
            height_age_s=age,
            climb_mps=self._climb,
            battery=self._battery,
            armed=self._armed,
            mode=self._mode,
            landed=self._landed if self._landed is not None else not self._armed,
            position_ok=self.attitude_time - self._position_at <= _FRESH_S,
            texts=texts,
            acks=acks,
        )

    def _on_heartbeat(self, message: Any) -> None:
        armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if not armed or not self._armed:
            self._ground = self._height
        if not armed and self.attitude_time - self._range_at > _RANGEFINDER_FRESH_S:
            self._has_range = False  # on the ground a rangefinder may be nearer than it can see
        self._armed = armed
        reader = MODE_READERS.get(message.autopilot)
        self._mode = reader(message.custom_mode) if reader is not None else FlightMode.OTHER
        self._heard_heartbeat = self._beat_is_new = True

    def _on_attitude(self, message: Any) -> None:
        if not (math.isfinite(message.yaw) and math.isfinite(message.yawspeed)):
            return
        self.attitude_time = message.time_boot_ms / 1000.0
        self._stamp = self.attitude_time if self._clock is None else self._clock()
        if self._beat_is_new:
            self._beat_at, self._beat_is_new = self._stamp, False
        self._yaw = ned.swap_yaw(message.yaw)
        self._yaw_rate = ned.swap_flu_frd(0.0, 0.0, message.yawspeed)[2]

    def _on_position(self, message: Any) -> None:
        if not all(map(math.isfinite, (message.x, message.y, message.z, message.vz))):
            return
        _, _, self._height = ned.swap_enu_ned(message.x, message.y, message.z)
        _, _, self._climb = ned.swap_enu_ned(message.vx, message.vy, message.vz)
        self._position_at = message.time_boot_ms / 1000.0
        if not self._armed:
            self._ground = self._height

    def _on_range(self, message: Any) -> None:
        looks_down = message.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270
        is_in_range = message.min_distance <= message.current_distance <= message.max_distance
        if looks_down and is_in_range and message.signal_quality != _SIGNAL_INVALID:
            self._range_m = message.current_distance / 100.0
            self._range_at = message.time_boot_ms / 1000.0
            self._has_range = True

    def _on_battery(self, message: Any) -> None:
        if message.battery_remaining >= 0:
            self._battery = min(message.battery_remaining, 100) / 100.0

    def _on_landed(self, message: Any) -> None:
        if message.landed_state != mavlink.MAV_LANDED_STATE_UNDEFINED:
            self._landed = message.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND

    def _on_text(self, message: Any) -> None:
        """Join the chunks of long texts: all but the last fill their 50 bytes."""
        text = str(message.text)
        if message.id:
            text = (self._chunks.pop(message.id, "") if message.chunk_seq else "") + text
            if len(message.text) == _TEXT_BYTES and len(self._chunks) < _MOST_TEXTS:
                self._chunks[message.id] = text
                return
        if len(self._texts) < _MOST_TEXTS:
            self._texts.append(text)

    def _on_ack(self, message: Any) -> None:
        command = self._expected.get(message.command)
        if command is None:
            return
        name = mavlink.enums["MAV_RESULT"].get(message.result)
        result = name.name.removeprefix("MAV_RESULT_") if name is not None else f"result {message.result}"
        self._acks.append(Ack(command, message.result == mavlink.MAV_RESULT_ACCEPTED, result))
