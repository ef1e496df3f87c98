"""The autopilot over MAVLink 2 and UDP: pymavlink's message classes on a plain non-blocking socket.

MAVSDK is not used here: its offboard plugin repeats the last setpoint from a thread of its own, which would outlive a
dead runner. Everything a datagram holds is taken or dropped by itself, so that a damaged one cannot spoil the next.
"""

from __future__ import annotations

import logging
import math
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

from pymavlink.dialects.v20 import common as mavlink

from imagine.core import ned
from imagine.core.errors import InputError
from imagine.mesh_comm.link_url import parse_udp_url
from imagine.onboard.records import OdometryOut, Setpoint, Telemetry, VehicleCommand
from imagine.onboard.telemetry import TelemetryAssembler

_log = logging.getLogger(__name__)

ONBOARD_COMPUTER = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER  # 191
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1  # 1
VELOCITY_AND_YAW_RATE = 0x5C7
"""Type mask: ignore position, acceleration and yaw; take all three velocities (one missing drops all) and yaw rate."""
_PX4_OFFBOARD = 6
_READ_BYTES = 65535
_MOST_DATAGRAMS = 500  # in one go, so that a flood cannot hold the loop
_PEER_SILENT_S = 2.0  # only then may the vehicle speak from another address
_MAGIC_V2, _MAGIC_V1 = 0xFD, 0xFE


class MavlinkAutopilot:
    """The `Autopilot` port over UDP; `clock` stamps what arrives, None takes the vehicle's own time (lockstep)."""

    def __init__(self, url: str, system: int, clock: Callable[[], float] | None = None) -> None:
        """Open `udpin://host:port` (the vehicle speaks first) or `udpout://host:port`; `system` is the vehicle's id.

        Raises InputError on a wrong address or a port in use.
        """
        self.system = system
        self.dropped: dict[str, int] = {"malformed": 0, "foreign": 0, "unsent": 0}
        self._peer: tuple[str, int] | None = None
        self._peer_at = -math.inf
        self._socket = self._open(url)
        self._codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=ONBOARD_COMPUTER)
        self._assembler = TelemetryAssembler(clock)
        self._beat_at = -math.inf
        self._asked: dict[VehicleCommand, int] = {}

    def telemetry(self) -> Telemetry | None:
        """Take in all that has arrived and return the newest; None until the vehicle's attitude is known."""
        self._drain()
        return self._assembler.take()

    def wait_telemetry(self, stamp: float, timeout_s: float) -> Telemetry | None:
        """Return telemetry whose attitude is of `stamp` (vehicle's time, seconds) or later, or None at the deadline."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._drain()
            if self._assembler.attitude_time >= stamp - 1e-3:
                return self._assembler.take()
            left = deadline - time.monotonic()
            if left <= 0.0:
                return None
            select.select([self._socket], [], [], left)

    def beat(self) -> None:
        """Take in what has arrived, and send the companion computer's HEARTBEAT once a second of wall time."""
        self._drain()
        now = time.monotonic()
        if self._peer is None or now - self._beat_at < 1.0:
            return
        self._beat_at = now
        self._send(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
            )
        )

    def send_command(self, command: VehicleCommand) -> None:
        """Send a COMMAND_LONG; asked again, its confirmation counts up."""
        asked = self._asked.get(command, -1) + 1
        self._asked[command] = asked
        if command is VehicleCommand.OFFBOARD:
            number, params = mavlink.MAV_CMD_DO_SET_MODE, (1.0, float(_PX4_OFFBOARD), 0.0, 0.0, 0.0, 0.0, 0.0)
        elif command is VehicleCommand.LAND:
            number, params = mavlink.MAV_CMD_NAV_LAND, (0.0, 0.0, 0.0, math.nan, math.nan, math.nan, 0.0)
        else:
            armed = 1.0 if command is VehicleCommand.ARM else 0.0
            number, params = mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (armed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._assembler.expect_ack(number, command)
        self._send(mavlink.MAVLink_command_long_message(self.system, AUTOPILOT, number, min(asked, 255), *params))

    def send_odometry(self, odometry: OdometryOut) -> None:
        """Send ODOMETRY: pose in the local FRD frame, velocity in the body's; all variances finite."""
        x, y, z = ned.swap_enu_ned(odometry.pose.x, odometry.pose.y, odometry.height_m)
        half = 0.5 * ned.swap_yaw(odometry.pose.yaw)
        vx, vy, vz = ned.swap_flu_frd(*odometry.velocity)
        _, _, yaw_rate = ned.swap_flu_frd(0.0, 0.0, odometry.yaw_rate)
        level = math.radians(2.0) ** 2  # roll and pitch are not estimated here: the vehicle flies level
        position, velocity = odometry.position_variance, odometry.velocity_variance
        height, yaw = odometry.height_variance, odometry.yaw_variance
        numbers = (odometry.stamp, x, y, z, half, vx, vy, vz, yaw_rate, position, velocity, height, yaw)
        if not all(map(math.isfinite, numbers)):
            self.dropped["unsent"] += 1
            return
        self._send(
            mavlink.MAVLink_odometry_message(
                round(odometry.stamp * 1e6),
                mavlink.MAV_FRAME_LOCAL_FRD,
                mavlink.MAV_FRAME_BODY_FRD,
                x, y, z, [math.cos(half), 0.0, 0.0, math.sin(half)], vx, vy, vz, 0.0, 0.0, yaw_rate,
                _diagonal(position, position, height, level, level, yaw),
                _diagonal(velocity, velocity, velocity, level, level, level),
                odometry.reset_counter % 256,
                mavlink.MAV_ESTIMATOR_TYPE_LIDAR,
                100,
            )
        )  # fmt: skip

    def send_setpoint(self, setpoint: Setpoint, stamp: float) -> None:
        """Send a body-frame velocity setpoint; one that is not finite is counted and kept back."""
        vx, vy, vz = ned.swap_flu_frd(setpoint.vx, setpoint.vy, setpoint.vz)
        _, _, yaw_rate = ned.swap_flu_frd(0.0, 0.0, setpoint.yaw_rate)
        if not all(map(math.isfinite, (stamp, vx, vy, vz, yaw_rate))):
            self.dropped["unsent"] += 1
            return
        self._send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                round(stamp * 1000.0) % 2**32, self.system, AUTOPILOT, mavlink.MAV_FRAME_BODY_NED,
                VELOCITY_AND_YAW_RATE, 0.0, 0.0, 0.0, vx, vy, vz, 0.0, 0.0, 0.0, 0.0, yaw_rate,
            )
        )  # fmt: skip

    def send_text(self, text: str) -> None:
        """Send a STATUSTEXT, cut to the 50 bytes of one message."""
        line = text.encode("ascii", "replace")[:50]
        self._send(mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_NOTICE, line))

    def fileno(self) -> int:
        """Return the socket's descriptor, to wait on."""
        return self._socket.fileno()

    @property
    def port(self) -> int:
        """The local UDP port."""
        return int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _open(self, url: str) -> socket.socket:
        scheme = urlsplit(url).scheme
        if scheme not in ("udpin", "udpout"):
            raise InputError(f"{url}: the vehicle's URL is udpin://host:port or udpout://host:port")
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setblocking(False)
        try:
            if scheme == "udpin":
                opened.bind(parse_udp_url(url, scheme))
            else:
                host, port = parse_udp_url(url, scheme)
                self._peer = (socket.gethostbyname(host), port)
        except InputError:
            opened.close()
            raise
        except OSError as error:
            opened.close()
            raise InputError(f"{url}: the vehicle's port cannot be opened: {error.strerror or error}") from error
        return opened

    def _send(self, message: Any) -> None:
        if self._peer is None:
            return  # not yet heard: there is nowhere to send to
        try:
            packed = message.pack(self._codec)
            self._codec.seq = (self._codec.seq + 1) % 256
            self._socket.sendto(packed, self._peer)
        except (OSError, struct.error, OverflowError) as error:  # a network that comes and goes must not end the runner
            if self.dropped["unsent"] == 0:
                _log.warning("not sent: %s (further ones are counted, not logged)", error)
            self.dropped["unsent"] += 1

    def _drain(self) -> None:
        for _ in range(_MOST_DATAGRAMS):
            try:
                datagram, sender = self._socket.recvfrom(_READ_BYTES)
            except BlockingIOError:
                return
            except OSError:  # the vehicle's port is closed, or its network away, for now
                continue
            now = time.monotonic()
            for message in self._messages(datagram):
                if message.get_srcSystem() != self.system or message.get_srcComponent() != AUTOPILOT:
                    self.dropped["foreign"] += 1
                    continue
                if sender != self._peer and now - self._peer_at < _PEER_SILENT_S:
                    self.dropped["foreign"] += 1
                    continue
                self._peer, self._peer_at = sender, now
                self._assembler.feed(message)

    def _messages(self, datagram: bytes) -> Iterator[Any]:
        """Yield the messages of one datagram; what cannot be read is counted, and the rest of it dropped."""
        at = 0
        while at < len(datagram):
            length = _frame_length(datagram, at)
            if length is None or at + length > len(datagram):
                self.dropped["malformed"] += 1
                return
            try:
                message = self._codec.decode(bytearray(datagram[at : at + length]))
            except mavlink.MAVError:
                self.dropped["malformed"] += 1
                return
            at += length
            if message.get_msgId() in mavlink.mavlink_map:  # others may be newer than this dialect: not an error
                yield message


def _frame_length(datagram: bytes, at: int) -> int | None:
    """Return the length of the MAVLink frame that begins here, or None where none does."""
    if len(datagram) - at < 8:
        return None
    payload = datagram[at + 1]
    if datagram[at] == _MAGIC_V2:
        incompatible = datagram[at + 2]
        if incompatible & ~mavlink.MAVLINK_IFLAG_SIGNED:
            return None
        return 12 + payload + (13 if incompatible else 0)
    return 8 + payload if datagram[at] == _MAGIC_V1 else None


def _diagonal(*variances: float) -> list[float]:
    """Return the upper triangle of a 6 x 6 covariance, row by row, as MAVLink carries it."""
    triangle: list[float] = []
    for row, variance in enumerate(variances):
        triangle += [variance] + [0.0] * (len(variances) - row - 1)
    return triangle
