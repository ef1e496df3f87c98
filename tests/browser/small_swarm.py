"""Three real mesh nodes that fly around the small world and a ground fleet that hears them, under a driven clock."""

from __future__ import annotations

from small_world import cast, pose_on_path

from imagine.core.evidence import EvidenceMap
from imagine.core.lidar import LD19
from imagine.gcs.fleet import Fleet
from imagine.gcs.server import GroundServer
from imagine.gcs.station import obey
from imagine.mesh_comm.messages import Status
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import Sealer
from imagine.mesh_comm.settings import Frame

KEY = bytes(range(32))
TICK_S = 0.1
SPEED_MPS = 0.6
RANGE_CAP_M = 2.0  # short, so that the map grows for a while
LADDER = {"hold": "hold", "land": "land", "resume": "policy"}


class Drone:
    """A drone that flies its path, maps, talks, and does what the pilot orders."""

    def __init__(self, id_: int, settings: MeshSettings) -> None:
        self.id = id_
        self.evidence = EvidenceMap(own=id_)
        self.node = MeshNode(self.evidence, LD19, RANGE_CAP_M, settings, Sealer(KEY, id_, 1))
        self.flown_m = 0.0
        self.ladder, self.reason = "policy", ""
        self.orders: list[str] = []
        self.sends = True

    def tick(self, now: float) -> list[bytes]:
        for order in self.node.commands():
            self.orders.append(order.action)
            self.ladder, self.reason = LADDER[order.action], f"the pilot orders to {order.action}"
        speed = SPEED_MPS if self.ladder == "policy" else 0.0
        self.flown_m += speed * TICK_S
        pose = pose_on_path(self.id, self.flown_m)
        scan = cast(pose, LD19, now)
        self.evidence.integrate(pose, scan, LD19, RANGE_CAP_M)
        battery = 0.9 - 0.2 * (self.id - 1) - now / 1000
        status = Status(
            self.id, now, pose, (speed, 0.0), 1.0, battery, "OFFBOARD", True, ladder=self.ladder, reason=self.reason
        )
        self.node.set_status(status)
        self.node.offer_scan(scan, pose, now)
        return self.node.poll(now)


class Swarm:
    """The drones, the ground, and the air between them; `run` lets simulated time pass and publishes the outcome."""

    def __init__(self, server: GroundServer, frame: Frame = "shared") -> None:
        settings = MeshSettings(frame=frame)
        self.fleet = Fleet(settings, Sealer(KEY, 0, 1), range_cap_m=RANGE_CAP_M)
        self.drones = {i: Drone(i, settings) for i in (1, 2, 3)}
        self.server = server
        self.now = 0.0

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.now += TICK_S
            obey(self.fleet, self.server, self.now)
            said = {0: self.fleet.poll(self.now)}
            said |= {i: drone.tick(self.now) for i, drone in self.drones.items() if drone.sends}
            for sender, datagrams in said.items():
                for datagram in datagrams:
                    if sender:
                        self.fleet.receive(datagram, self.now)
                    for i, drone in self.drones.items():
                        if i != sender and drone.sends:
                            drone.node.receive(datagram, self.now)
            snapshot = self.fleet.snapshot(self.now)
        self.server.publish(snapshot)
