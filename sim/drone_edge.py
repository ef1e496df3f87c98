"""What ties one simulated drone to its runner: vehicle link, LiDAR sender, radio modem, and their inboxes."""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec, Scan
from imagine.core.lidar_wire import encode_scan
from imagine.mesh_comm.markers import decode_marker, encode_marker
from imagine.sim.modem import Modem
from imagine.sim.sockets import Address, bind_udp, free_listen_port
from imagine.sim.vehicle import Vehicle
from imagine.sim.vehicle_link import VehicleLink
from imagine.sim.vehicle_messages import Message, boot_ms

logger = logging.getLogger(__name__)

_SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"
_PX4_PORT_OFFSET, _LIDAR_PORT_OFFSET, _MODEM_PORT_OFFSET = 40, 1000, 2000


@dataclass(frozen=True)
class Endpoint:
    """What the runner of one drone is given: `--vehicle`, `--lidar` and `--mesh` (None: no mesh)."""

    drone: int
    vehicle: str
    lidar: str
    mesh: str | None


class DroneEdge:
    """The sockets of drone `number`, and what has arrived on them and waits for its tick."""

    def __init__(
        self, number: int, vehicle: Vehicle, mesh: bool, host: str, runner_host: str, port_base: int | None
    ) -> None:
        """Bind the drone's ports: given ones from `port_base`, as PX4's 14540 + number, or any free ones."""
        self.number = number
        self.vehicle = vehicle
        self.silent = False
        self.heard_setpoint_s = -math.inf
        self.messages: deque[Message] = deque()
        self.datagrams: deque[bytes] = deque()
        self._answered_ms = -1
        self._marked_s = -math.inf
        if port_base is None:
            companion, lidar = free_listen_port(host), free_listen_port(host)
            own = modem = 0
        else:
            companion = port_base + number
            own = companion + _PX4_PORT_OFFSET
            lidar, modem = companion + _LIDAR_PORT_OFFSET, companion + _MODEM_PORT_OFFSET
        self.link = VehicleLink(number, (runner_host, companion), host, own)
        self._lidar_address: Address = (runner_host, lidar)
        self._lidar = bind_udp(host, 0, f"LiDAR of drone {number}")
        self.modem = Modem(f"drone {number}", host, modem) if mesh else None
        self.endpoint = Endpoint(
            number,
            f"udpin://{runner_host}:{companion}",
            f"udpin://{runner_host}:{lidar}",
            f"udpout://{host}:{self.modem.port}" if self.modem else None,
        )

    @property
    def connected(self) -> bool:
        """Whether the runner has been heard on every link it uses."""
        return self.link.heard > 0 and (self.modem is None or self.modem.peer is not None)

    def collect(self) -> None:
        """Move what has arrived on the sockets into the inboxes."""
        for message in self.link.receive():
            self.messages.append(message)
            if self.is_setpoint(message):
                self._answered_ms = message.time_boot_ms
                self.silent = False
        if self.modem is not None:
            for datagram in self.modem.receive():
                self.datagrams.append(datagram)
                marker = decode_marker(datagram)
                if marker is not None:
                    self._marked_s = marker

    def has_answered(self, stamp: float) -> bool:
        """Whether the setpoint, and with a mesh the marker, of the tick `stamp` have come."""
        return self._answered_ms == boot_ms(stamp) and (self.modem is None or abs(self._marked_s - stamp) < 1e-6)

    def take_messages(self, stamp: float | None) -> list[Message]:
        """Take the MAVLink messages up to the setpoint of the tick `stamp`, in order; None takes all."""
        taken: list[Message] = []
        while self.messages:
            message = self.messages.popleft()
            taken.append(message)
            if stamp is not None and self.is_setpoint(message) and message.time_boot_ms == boot_ms(stamp):
                break
        return taken

    def take_datagrams(self, stamp: float | None) -> list[bytes]:
        """Take the mesh datagrams up to the marker of the tick `stamp`, in order, without markers; None takes all."""
        taken: list[bytes] = []
        while self.datagrams:
            datagram = self.datagrams.popleft()
            marker = decode_marker(datagram)
            if marker is None:
                taken.append(datagram)
            elif stamp is not None and abs(marker - stamp) < 1e-6:
                break
        return taken

    def send_tick(
        self, telemetry: list[Message], mesh: list[bytes], ranges: NDArray[np.float32], lidar: LidarSpec, stamp: float
    ) -> None:
        """Send what the runner needs for one tick, the scan last: with it, all the rest has been sent."""
        self.link.send(telemetry)
        if self.modem is not None:
            self.modem.send([*mesh, encode_marker(stamp)])
        try:
            self._lidar.sendto(encode_scan(Scan(stamp, ranges), lidar), self._lidar_address)
        except OSError as error:
            logger.debug("LiDAR of drone %d cannot reach %s:%d: %s", self.number, *self._lidar_address, error)

    def is_setpoint(self, message: Message) -> bool:
        """Whether a message is a setpoint for this drone's vehicle."""
        return bool(message.get_type() == _SETPOINT and message.target_system in (0, self.number))

    def close(self) -> None:
        """Release the ports."""
        self.link.close()
        self._lidar.close()
        if self.modem is not None:
            self.modem.close()
