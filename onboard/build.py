"""Putting a runner together from settings, and warming it up before it counts."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.frontier import frontier_field, own_distance
from imagine.core.lidar import TEAMMATE_RADIUS_M, LidarSpec, Scan, mask_near
from imagine.core.observation import observe
from imagine.core.observation_spec import ObservationSpec
from imagine.core.peer_poses import PeerPoses
from imagine.core.placed_layer import PlacedLayer
from imagine.core.planner import plan_velocity
from imagine.core.shield import shield_velocity
from imagine.core.visits import VisitMap
from imagine.mesh_comm.keys import default_boot_file, find_keys, start_sealer
from imagine.mesh_comm.node import MeshNode
from imagine.mesh_comm.seal import KEY_BYTES, Sealer
from imagine.onboard.perception import Perception, PerceptionSettings
from imagine.onboard.policy import OnnxPolicy, Policy, check_fit
from imagine.onboard.records import FlightMode, Telemetry, TickInput
from imagine.onboard.runner import Runner
from imagine.onboard.settings import DroneSettings

_WARM_TICKS = 8


def build_runner(settings: DroneSettings, policy: Policy | None, sealer: Sealer | None) -> Runner:
    """Return a runner at its launch pose, with an empty map; `sealer` None leaves it without mesh."""
    evidence = EvidenceMap(settings.drone_id)
    launch = settings.launch.pose
    evidence.begin_at(launch.x, launch.y)
    mesh = None
    if sealer is not None:
        mesh = MeshNode(evidence, settings.lidar_spec, settings.map.range_cap_m, settings.radio, sealer)
    perception = Perception(settings.lidar_spec, PerceptionSettings(odometry=settings.odometry), launch)
    return Runner(settings, policy, perception, evidence, mesh)


def load_policy(settings: DroneSettings) -> OnnxPolicy | None:
    """Load the policy of the settings and check that it fits this drone. Raises InputError if it does not."""
    if settings.policy is None:
        return None
    policy = OnnxPolicy.load(settings.policy)
    check_fit(policy.contract, settings.lidar_spec, settings.map, settings.limits, str(settings.policy))
    return policy


def mesh_sealer(settings: DroneSettings, environ: Mapping[str, str], unix_time_s: float) -> Sealer | None:
    """Return the seal of this drone's mesh messages, None without mesh.

    Raises InputError without a key, for a key file that is named and cannot be used even where there is no mesh, and
    where the boot number cannot be remembered.
    """
    if settings.mesh is None and settings.key_file is None:
        return None
    keys = find_keys(settings.key_file, environ)
    if settings.mesh is None:
        return None
    boot_file = settings.boot_file or default_boot_file(settings.drone_id)
    return start_sealer(keys, settings.drone_id, boot_file, unix_time_s)


def warm_up(settings: DroneSettings, policy: Policy | None) -> None:
    """Run a throw-away drone through a few ticks: kernels are compiled or loaded, the model has run once.

    Also worth calling once before several drones start together: the compiled kernels stay in the cache on disk.
    """
    mates = [
        build_runner(settings.model_copy(update={"drone_id": number}), policy, Sealer(bytes(KEY_BYTES), number, boot=1))
        for number in (1, 2)
    ]
    for number in range(_WARM_TICKS):
        stamp = 0.1 * number
        telemetry = Telemetry(stamp, mode=FlightMode.HOLD, position_ok=True)
        scan = Scan(stamp, square_room(settings.lidar_spec, half_side_m=1.5 + 0.2 * number))
        spoken: tuple[bytes, ...] = ()
        for mate in mates:
            spoken = mate.tick(TickInput(stamp, scan, telemetry, spoken)).datagrams
    _rehearse_flight(settings, policy, scan, mates[0].evidence)


def _rehearse_flight(settings: DroneSettings, policy: Policy | None, scan: Scan, evidence: EvidenceMap) -> None:
    """Run once what only a drone in the air does: compiling it there would cost two seconds of silence."""
    spec, pose, lidar = ObservationSpec(), settings.launch.pose, settings.lidar_spec
    belief, origin = evidence.belief(), evidence.origin_cells
    field = frontier_field(belief)
    own_distance(field, origin, pose.x, pose.y)
    plan_velocity(field, origin, pose, scan, lidar, settings.limits.speed_mps)
    shield_velocity(0.1, 0.0, scan, lidar, settings.limits)
    PlacedLayer(Pose(0.1, 0.1, 0.1)).refresh(evidence.layers[evidence.own].cells, origin)
    mask_near(scan.ranges, lidar, pose, np.zeros((1, 2)), TEAMMATE_RADIUS_M)
    if policy is not None:
        spec = policy.contract.observation
    mates, visits = PeerPoses(np.zeros((1, 2)), np.zeros(1)), VisitMap()
    visits.fit(origin, evidence.shape)
    visits.count(pose.x, pose.y, mates)
    observation = observe(spec, belief, field, origin, pose, (0.0, 0.0), 0.0, scan, lidar, mates, visits)
    if policy is not None:
        policy.infer(observation, np.zeros(policy.contract.state_size, np.float32))


def square_room(spec: LidarSpec, half_side_m: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Return the ranges seen from the middle of a square room, facing a wall, float32 `[beams]`."""
    c, s = np.abs(np.cos(spec.bearings)), np.abs(np.sin(spec.bearings))
    ranges = half_side_m / np.maximum(np.maximum(c, s), math.sqrt(0.5))
    return ranges.astype(np.float32)
