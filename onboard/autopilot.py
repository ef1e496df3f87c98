"""The port to the autopilot, and a virtual one for tests and benches."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

from imagine.core.frames import rotate, wrap_angle
from imagine.onboard.records import Ack, FlightMode, OdometryOut, Setpoint, Telemetry, VehicleCommand


class Autopilot(Protocol):
    """What the runner's loop needs of a flight controller; `MavlinkAutopilot` and `VirtualAutopilot` give it."""

    def telemetry(self) -> Telemetry | None:
        """Take in what has arrived, without waiting, and return the newest; None until the vehicle is heard."""

    def wait_telemetry(self, stamp: float, timeout_s: float) -> Telemetry | None:
        """Return telemetry whose attitude is not older than `stamp`; None when the wall-clock deadline passes."""

    def beat(self) -> None:
        """Take in what has arrived, and say that this companion computer is alive; call it several times a second."""

    def send_command(self, command: VehicleCommand) -> None:
        """Ask for a mode or an action, once; its answer comes with the telemetry."""

    def send_odometry(self, odometry: OdometryOut) -> None:
        """Hand over the external pose estimate."""

    def send_setpoint(self, setpoint: Setpoint, stamp: float) -> None:
        """Command a velocity."""

    def send_text(self, text: str) -> None:
        """Show the pilot one line through the autopilot's link."""

    def close(self) -> None:
        """Release the link."""


class VirtualAutopilot:
    """An exact point that follows setpoints at once and keeps PX4's rules: no OFFBOARD without a stream of setpoints.

    Time moves only by `advance`. Its true state (`x`, `y`, `yaw`, `height`) is there for tests to read and to set.
    """

    STREAM_LOSS_S = 1.0
    LAND_SPEED_MPS = 0.5

    def __init__(self, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, battery: float = 1.0) -> None:
        """Put the vehicle on the ground, disarmed, in HOLD."""
        self.now, self.x, self.y, self.yaw, self.height = 0.0, x, y, yaw, 0.0
        self.state = Telemetry(0.0, yaw=yaw, battery=battery, mode=FlightMode.HOLD)
        self.deny: set[VehicleCommand] = set()
        self.commands: list[VehicleCommand] = []
        self.setpoints: list[tuple[float, Setpoint]] = []
        self.texts: list[str] = []
        self._stream_since: float | None = None
        self._odometry: OdometryOut | None = None
        self._acks: list[Ack] = []

    def telemetry(self) -> Telemetry | None:
        """Return the true state."""
        acks, self._acks = tuple(self._acks), []
        return replace(
            self.state,
            stamp=self.now,
            yaw=self.yaw,
            height_m=self.height,
            ranged=True,
            landed=self.height <= 0.0,
            position_ok=self._odometry is not None,
            acks=acks,
        )

    def wait_telemetry(self, stamp: float, timeout_s: float) -> Telemetry | None:
        """Return the true state if it is new enough; it never waits."""
        return self.telemetry() if self.now >= stamp else None

    def beat(self) -> None:
        """Nothing listens."""

    def send_command(self, command: VehicleCommand) -> None:
        """Obey as PX4 does, unless the test put the command among those to `deny`."""
        self.commands.append(command)
        streaming = self._stream_since is not None
        refused = command in self.deny or (command is VehicleCommand.ARM and self.state.mode is not FlightMode.OFFBOARD)
        self._acks.append(Ack(command, not refused, "TEMPORARILY_REJECTED" if refused else "ACCEPTED"))
        if refused:
            return
        if command is VehicleCommand.OFFBOARD:
            if streaming:  # without a stream PX4 accepts and stays where it is
                self.state = replace(self.state, mode=FlightMode.OFFBOARD)
        elif command is VehicleCommand.LAND:
            self.state = replace(self.state, mode=FlightMode.LAND)
        else:
            self.state = replace(self.state, armed=command is VehicleCommand.ARM)

    def send_odometry(self, odometry: OdometryOut) -> None:
        """Keep the newest estimate."""
        self._odometry = odometry

    def send_setpoint(self, setpoint: Setpoint, stamp: float) -> None:
        """Keep the setpoint and the stream alive."""
        self.setpoints.append((self.now, setpoint))
        if self._stream_since is None:
            self._stream_since = self.now

    def send_text(self, text: str) -> None:
        """Keep the text."""
        self.texts.append(text)

    def advance(self, dt_s: float) -> None:
        """Move the vehicle by one step of time."""
        self.now += dt_s
        if self.setpoints and self.now - self.setpoints[-1][0] > self.STREAM_LOSS_S:
            self._stream_since = None
            if self.state.mode is FlightMode.OFFBOARD:
                self.state = replace(self.state, mode=FlightMode.LAND)
        if not self.state.armed:
            return
        if self.state.mode is FlightMode.OFFBOARD and self.setpoints:
            wanted = self.setpoints[-1][1]
            dx, dy = rotate(self.yaw, wanted.vx * dt_s, wanted.vy * dt_s)
            self.x, self.y = self.x + dx, self.y + dy
            self.yaw = wrap_angle(self.yaw + wanted.yaw_rate * dt_s)
            self.height = max(0.0, self.height + wanted.vz * dt_s)
            self.state = replace(self.state, yaw_rate=wanted.yaw_rate, climb_mps=wanted.vz)
        elif self.state.mode is FlightMode.LAND:
            self.height = max(0.0, self.height - self.LAND_SPEED_MPS * dt_s)
            if math.isclose(self.height, 0.0):
                self.state = replace(self.state, armed=False)

    def close(self) -> None:
        """Nothing to release."""
