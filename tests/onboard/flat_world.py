"""A small flat world for the onboard tests: axis-parallel walls, exact rays, and a runner flown through it."""

from __future__ import annotations

import numpy as np

from imagine.core.evidence import EvidenceMap
from imagine.core.lidar import LD19, Scan
from imagine.onboard.autopilot import VirtualAutopilot
from imagine.onboard.perception import Perception
from imagine.onboard.records import TickInput, TickOutput
from imagine.onboard.runner import Runner
from imagine.onboard.settings import DroneSettings

DT = 0.1

TWO_ROOMS = np.array(
    [
        # x0, y0, x1, y1: an 8 x 4 m outline, a wall with a door of 1.2 m, and some furniture
        [0.0, 0.0, 8.0, 0.0],
        [8.0, 0.0, 8.0, 4.0],
        [8.0, 4.0, 0.0, 4.0],
        [0.0, 4.0, 0.0, 0.0],
        [4.0, 0.0, 4.0, 1.4],
        [4.0, 2.6, 4.0, 4.0],
        [1.0, 3.2, 1.8, 3.2],
        [6.5, 0.8, 7.1, 0.8],
        [6.5, 0.8, 6.5, 1.3],
    ]
)


def ray_ranges(walls: np.ndarray, x: float, y: float, yaw: float) -> np.ndarray:
    """Exact ranges of the reference LiDAR, float32 [360]."""
    bearing = LD19.bearings + yaw
    direction = np.stack((np.cos(bearing), np.sin(bearing)), axis=1)[:, None, :]
    start, edge = walls[None, :, :2], walls[None, :, 2:] - walls[None, :, :2]
    to_start = start - np.array([x, y])
    cross = direction[..., 0] * edge[..., 1] - direction[..., 1] * edge[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (to_start[..., 0] * edge[..., 1] - to_start[..., 1] * edge[..., 0]) / cross
        share = (to_start[..., 0] * direction[..., 1] - to_start[..., 1] * direction[..., 0]) / cross
    hit = (np.abs(cross) > 1e-12) & (along > 0.0) & (share >= 0.0) & (share <= 1.0)
    nearest = np.where(hit, along, np.inf).min(axis=1)
    return np.where(nearest <= LD19.range_max, nearest, np.inf).astype(np.float32)


def make_runner(settings: DroneSettings, policy=None, mesh=None, evidence: EvidenceMap | None = None) -> Runner:
    evidence = evidence if evidence is not None else EvidenceMap(settings.drone_id)
    perception = Perception(settings.lidar_spec, launch=settings.launch.pose)
    return Runner(settings, policy, perception, evidence, mesh)


class FlatFlight:
    """A runner, a virtual autopilot and a world, moved tick by tick as the loop in flight moves them."""

    def __init__(self, settings: DroneSettings, policy=None, walls: np.ndarray = TWO_ROOMS, seed: int = 0) -> None:
        launch = settings.launch.pose
        self.walls = walls
        self.rng = np.random.default_rng(seed)
        self.vehicle = VirtualAutopilot(launch.x, launch.y, launch.yaw)
        self.runner = make_runner(settings, policy)
        self.inputs: list[TickInput] = []
        self.outputs: list[TickOutput] = []

    def scan(self) -> Scan:
        ranges = ray_ranges(self.walls, self.vehicle.x, self.vehicle.y, self.vehicle.yaw)
        noise = self.rng.normal(0.0, 0.01, len(ranges)).astype(np.float32)
        return Scan(self.vehicle.now, ranges + noise)

    def tick(self, has_scan: bool = True, **extra) -> TickOutput:
        """Advance the world by one tick and run the runner in it."""
        self.vehicle.advance(DT)
        scan = self.scan() if has_scan else None
        inputs = TickInput(self.vehicle.now, scan, self.vehicle.telemetry(), **extra)
        output = self.runner.tick(inputs)
        for command in output.commands:
            self.vehicle.send_command(command)
        if output.odometry is not None:
            self.vehicle.send_odometry(output.odometry)
        if output.setpoint is not None:
            self.vehicle.send_setpoint(output.setpoint, inputs.now)
        self.inputs.append(inputs)
        self.outputs.append(output)
        return output

    def fly_until(self, reached, longest_s: float = 60.0) -> TickOutput:
        """Tick until `reached(output)`; fail loudly if it never comes."""
        for _ in range(round(longest_s / DT)):
            output = self.tick()
            if reached(output):
                return output
        raise AssertionError(f"not reached in {longest_s} s; last status {self.outputs[-1].status}")
