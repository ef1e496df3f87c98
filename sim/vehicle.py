"""One PX4-like vehicle as MAVLink sees it: messages in, messages out, velocity setpoints for the physics. No I/O."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from imagine.core.frames import rotate, wrap_angle
from imagine.sim import vehicle_messages as build
from imagine.sim.flight_control import AIRBORNE_M, Failsafe, FlightControl, Mode, Result, VehicleSettings
from imagine.sim.vehicle_estimate import VehicleEstimate
from imagine.sim.vehicle_inputs import read_odometry, read_setpoint
from imagine.sim.vehicle_messages import Message
from imagine.sim.vehicle_params import OFFBOARD_LOSS, TAKEOFF_HEIGHT, ParamTable

AUTOPILOT_COMPONENT = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
_FORCE = 21196.0  # the magic number that forces arming or disarming
_YAW_GAIN = 2.0  # rad/s of yaw rate per radian of heading error
_LONGEST_INTERVAL_US = 60e6
_EVERY_TICK = 0.0
_OFF = math.inf
_STREAMS = {  # message id -> seconds between two; ATTITUDE is always the last of its tick
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 0.2,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: _EVERY_TICK,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _EVERY_TICK,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _OFF,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _EVERY_TICK,
}


class Vehicle:
    """A PX4-like autopilot whose only position source is ODOMETRY; state advances in `step` alone.

    `rejected` counts, by reason, what was addressed to it and could not be used.
    """

    def __init__(
        self,
        system_id: int,
        settings: VehicleSettings,
        rng: np.random.Generator,
        yaw: float = 0.0,
        height_m: float = 0.0,
    ) -> None:
        """Stand with heading `yaw` (map frame, radians); `rng` draws the gyro's bias and all noise."""
        self.system_id = system_id
        self.settings = settings
        self.control = FlightControl(settings)
        self.control.height_m = height_m
        self.estimate = VehicleEstimate(yaw)
        self.params = ParamTable(settings)
        self.rejected: Counter[str] = Counter()
        self._rng = rng
        self._gyro_bias = float(rng.normal(0.0, settings.gyro_bias_std_rps))
        self._measured_height_m = height_m
        self._intervals = dict(_STREAMS)
        self._due: dict[int, float] = {}
        self._announced: tuple[int, bool, bool] | None = None
        self._text_id = 0
        self._handlers: dict[str, Callable[[Message, float], list[Message]]] = {
            "COMMAND_LONG": self._on_command_long,
            "COMMAND_INT": self._on_command_int,
            "SET_MODE": self._on_set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
            "ODOMETRY": self._on_odometry,
            "PARAM_REQUEST_LIST": self._on_param_list,
            "PARAM_REQUEST_READ": self._on_param_read,
            "PARAM_SET": self._on_param_set,
            "MISSION_REQUEST_LIST": self._on_mission_list,
            "TIMESYNC": self._on_timesync,
            "PING": self._on_ping,
        }

    @property
    def mode(self) -> Mode:
        """The flight mode."""
        return self.control.mode

    @property
    def armed(self) -> bool:
        """Whether the motors run."""
        return self.control.armed

    @property
    def height_m(self) -> float:
        """True height above the ground, metres."""
        return self.control.height_m

    @property
    def battery(self) -> float:
        """Charge left, 0 to 1."""
        return self.control.battery

    @property
    def failsafes(self) -> tuple[Failsafe, ...]:
        """Every time it took over by itself, oldest first."""
        return tuple(self.control.failsafes)

    def step(self, now: float, dt: float, yaw_rate: float) -> list[Message]:
        """Advance by `dt` seconds to the time `now`, turning truly at `yaw_rate` (rad/s); return the telemetry due."""
        gyro_noise, height_noise = self._rng.standard_normal(2)
        measured = yaw_rate + self._gyro_bias + self.settings.gyro_noise_std_rps * float(gyro_noise)
        if not self.control.has_position(now):
            self.estimate.stop()
        self.estimate.propagate(measured if dt > 0.0 else 0.0, dt)
        self.control.update(now, dt)
        self._measured_height_m = self.control.height_m + self.settings.height_noise_std_m * float(height_noise)
        return self._telemetry(now)

    def velocity_setpoint(self, now: float) -> tuple[float, float, float]:
        """Return the body velocity the airframe is held to: forward and left m/s, yaw rate rad/s counter-clockwise."""
        control = self.control
        if not control.airborne:
            return 0.0, 0.0, 0.0
        yaw = self.estimate.yaw
        trusted = control.has_position(now)
        forward = left = yaw_rate = 0.0
        if control.mode is Mode.OFFBOARD and control.setpoint is not None and trusted:
            wanted = control.setpoint
            forward, left = (wanted.vx, wanted.vy) if wanted.in_body else rotate(-yaw, wanted.vx, wanted.vy)
            yaw_rate = wanted.yaw_rate if wanted.yaw is None else _YAW_GAIN * wrap_angle(wanted.yaw - yaw)
        if not trusted:  # nothing tells it that the wind carries it away
            drift_forward, drift_left = rotate(-yaw, *self.settings.wind_mps)
            forward, left = forward + drift_forward, left + drift_left
        return forward, left, yaw_rate - self._gyro_bias

    def heartbeat(self) -> Message:
        """Return a HEARTBEAT outside the schedule, for the time before the first tick."""
        return build.heartbeat(self.control)

    def receive(self, message: Message, now: float) -> list[Message]:
        """Take in one message at the time `now`; return the answers. What is meant for another system is ignored."""
        if getattr(message, "target_system", 0) not in (0, self.system_id):
            return []
        if getattr(message, "target_component", 0) not in (0, AUTOPILOT_COMPONENT):
            return []
        handler = self._handlers.get(message.get_type())
        return handler(message, now) if handler is not None else []

    # -- telemetry ---------------------------------------------------------------------------------------------------

    def _telemetry(self, now: float) -> list[Message]:
        control = self.control
        messages: list[Message] = []
        announced = (control.mode.custom_mode, control.armed, control.landed)
        if announced != self._announced:  # do not let a change wait for its turn
            self._announced = announced
            self._due[mavlink.MAVLINK_MSG_ID_HEARTBEAT] = self._due[mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE] = now
        for text in control.notices:
            critical = text.startswith("Failsafe")
            severity = mavlink.MAV_SEVERITY_CRITICAL if critical else mavlink.MAV_SEVERITY_INFO
            self._text_id = self._text_id % 65535 + 1
            messages += build.status_text(text, severity, self._text_id)
        control.notices.clear()
        for message_id, interval in self._intervals.items():
            if interval == _OFF or now < self._due.get(message_id, now) - 1e-6:
                continue
            message = self._build(message_id, now)
            if message is not None:
                self._due[message_id] = now + interval
                messages.append(message)
        return messages

    def _build(self, message_id: int, now: float) -> Message | None:
        """Return the message of this id as of now; None when the vehicle has nothing to say or does not know it."""
        control, estimate, height = self.control, self.estimate, self._measured_height_m
        if message_id == mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            known = control.has_position(now)
            return build.local_position(estimate, height, control.climb_mps, now) if known else None
        builders: dict[int, Callable[[], Message]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: lambda: build.heartbeat(control),
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: lambda: build.sys_status(control, now),
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: lambda: build.battery_status(control),
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: lambda: build.extended_sys_state(control),
            mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: lambda: build.distance_sensor(height, now),
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: lambda: build.attitude_quaternion(estimate, now),
            mavlink.MAVLINK_MSG_ID_ATTITUDE: lambda: build.attitude(estimate, now),
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: lambda: build.autopilot_version(self.system_id),
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: build.home_position,
        }
        builder = builders.get(message_id)
        return builder() if builder is not None else None

    # -- setpoints and odometry --------------------------------------------------------------------------------------

    def _on_setpoint(self, m: Message, now: float) -> list[Message]:
        setpoint = read_setpoint(m)
        if isinstance(setpoint, str):
            self.rejected[setpoint] += 1
        else:
            self.control.take_setpoint(setpoint, now)
        return []

    def _on_odometry(self, m: Message, now: float) -> list[Message]:
        pose = read_odometry(m)
        if isinstance(pose, str):
            self.rejected[pose] += 1
        else:
            self.estimate.fuse(pose)
            self.control.take_position(now)
        return []

    # -- commands ----------------------------------------------------------------------------------------------------

    def _on_command_long(self, m: Message, now: float) -> list[Message]:
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        return self._command(m, int(m.command), params, now)

    def _on_command_int(self, m: Message, now: float) -> list[Message]:
        params = (m.param1, m.param2, m.param3, m.param4, float(m.x), float(m.y), m.z)
        return self._command(m, int(m.command), params, now)

    def _command(self, m: Message, command: int, params: tuple[float, ...], now: float) -> list[Message]:
        result, answers = self._execute(command, params, now)
        ack = mavlink.MAVLink_command_ack_message(command, int(result), 0, 0, m.get_srcSystem(), m.get_srcComponent())
        return [ack, *answers]

    def _execute(self, command: int, params: tuple[float, ...], now: float) -> tuple[Result, list[Message]]:
        control = self.control
        first, second, third = params[0], params[1], params[2]
        if command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            force = second == _FORCE
            return control.arm(now, force) if first == 1.0 else control.disarm(force), []
        if command == mavlink.MAV_CMD_DO_FLIGHTTERMINATION:
            return (control.disarm(force=True) if first == 1.0 else Result.ACCEPTED), []
        if command == mavlink.MAV_CMD_NAV_TAKEOFF:
            return control.take_off(params[6], now), []
        if command == mavlink.MAV_CMD_NAV_LAND:
            return control.set_mode(Mode.LAND, now), []
        if command == mavlink.MAV_CMD_DO_SET_MODE:
            return self._set_mode(_whole(second), _whole(third), now), []
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            message = self._build(_whole(first), now)
            return (Result.ACCEPTED, [message]) if message is not None else (Result.DENIED, [])
        if command == mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            return Result.ACCEPTED, [build.autopilot_version(self.system_id)]
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return self._set_interval(_whole(first), second, now), []
        if command == mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
            return self._get_interval(_whole(first))
        return Result.UNSUPPORTED, []

    def _on_set_mode(self, m: Message, now: float) -> list[Message]:
        self._set_mode(m.custom_mode >> 16 & 0xFF, m.custom_mode >> 24 & 0xFF, now)
        return []

    def _set_mode(self, main: int, sub: int, now: float) -> Result:
        for mode in Mode:
            if mode.value == (main, sub if main == Mode.HOLD.value[0] else 0):
                return self.control.set_mode(mode, now)
        return Result.DENIED  # it has neither a radio control for the manual modes nor a mission

    def _set_interval(self, message_id: int, interval_us: float, now: float) -> Result:
        if message_id not in self._intervals or not interval_us <= _LONGEST_INTERVAL_US:  # not a number included
            return Result.DENIED
        if interval_us < 0.0:
            self._intervals[message_id] = _OFF
        else:
            self._intervals[message_id] = _STREAMS[message_id] if interval_us == 0.0 else interval_us / 1e6
        self._due[message_id] = now
        return Result.ACCEPTED

    def _get_interval(self, message_id: int) -> tuple[Result, list[Message]]:
        interval = self._intervals.get(message_id)
        microseconds = 0 if interval is None else -1 if interval == _OFF else round(1e6 * interval)
        return Result.ACCEPTED, [mavlink.MAVLink_message_interval_message(message_id & 0xFFFF, microseconds)]

    # -- parameters and small protocols ------------------------------------------------------------------------------

    def _on_param_list(self, m: Message, now: float) -> list[Message]:
        return self.params.answer_list()

    def _on_param_read(self, m: Message, now: float) -> list[Message]:
        return self.params.answer_read(m)

    def _on_param_set(self, m: Message, now: float) -> list[Message]:
        answer, problem = self.params.answer_set(m)
        if problem is not None:
            self.rejected[problem] += 1
        self.control.offboard_loss_s = max(0.1, self.params[OFFBOARD_LOSS])
        self.control.takeoff_height_m = max(AIRBORNE_M, self.params[TAKEOFF_HEIGHT])
        return answer

    def _on_mission_list(self, m: Message, now: float) -> list[Message]:
        return [mavlink.MAVLink_mission_count_message(m.get_srcSystem(), m.get_srcComponent(), 0, m.mission_type)]

    def _on_timesync(self, m: Message, now: float) -> list[Message]:
        return [mavlink.MAVLink_timesync_message(round(1e9 * now), m.ts1)] if m.tc1 == 0 else []

    def _on_ping(self, m: Message, now: float) -> list[Message]:
        if m.target_system != 0:
            return []
        return [mavlink.MAVLink_ping_message(m.time_usec, m.seq, m.get_srcSystem(), m.get_srcComponent())]


def _whole(value: float) -> int:
    """Return a command's parameter as the whole number it stands for; -1 when it is none."""
    return int(value) if math.isfinite(value) else -1
