"""`imagine sim`: the twin serves vehicles, LiDARs and radio to runners elsewhere, on a bench or in another terminal."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass, field

from rich.console import Console

from imagine.core.errors import WorkError
from imagine.core.frames import Pose
from imagine.first_start import warm_twin
from imagine.sim.drone_edge import Endpoint
from imagine.sim.level import load_level
from imagine.sim.server import SitlServer, SitlSettings, TickRecord
from imagine.sim.twin import Twin
from imagine.sim.twin_settings import TwinSettings
from imagine.stop_signals import StopSignals

_LINE_TICKS = 100


@dataclass(frozen=True)
class ServeOptions:
    """What `imagine sim` is asked for; `ticks` 0 serves until it is stopped, `wait_s` is for runners to connect."""

    level: str = "4"
    drones: int = 3
    base_port: int = 14540
    host: str = "127.0.0.1"
    runner_host: str = "127.0.0.1"
    lockstep: bool = False
    speed: float = 1.0
    mesh: bool = True
    ticks: int = 0
    seed: int = 0
    wait_s: float = 600.0
    twin: TwinSettings = field(default_factory=TwinSettings)


def serve_twin(options: ServeOptions) -> None:
    """Serve until the ticks are over, SIGINT or SIGTERM comes, or in lockstep every runner has gone.

    Raises InputError for a bad level or a port in use, WorkError where a runner never connects.
    """
    console = Console(highlight=False, soft_wrap=True)
    level = load_level(options.level)
    poses = level.launch_poses(options.drones)
    twin = Twin(
        [level], options.drones, seed=options.seed, dynamics=options.twin.dynamics, sensing=options.twin.sensing
    )
    settings = SitlSettings(
        lockstep=options.lockstep,
        speed=options.speed,
        mesh=options.mesh,
        host=options.host,
        runner_host=options.runner_host,
        port_base=options.base_port,
        ground_modem=options.mesh,
        radio=options.twin.radio,
    )
    with StopSignals() as stopping, SitlServer(twin, settings, options.seed) as server:
        warm_twin()  # before anyone waits for a tick
        for endpoint, pose in zip(server.endpoints, poses, strict=True):
            console.print(f"drone {endpoint.drone}: {runner_command(endpoint, pose, options)}")
        if server.ground_endpoint is not None:
            console.print(f"ground station: imagine gcs --mesh {server.ground_endpoint}")
            console.print(
                "one key for all of them: imagine keygen swarm.key, then export IMAGINE_MESH_KEY=$(cat swarm.key)"
            )
        console.print(f"waiting for {options.drones} runners; Ctrl-C ends")
        started = time.monotonic()
        server.wait_connected(options.wait_s)
        console.print(f"all connected after {time.monotonic() - started:.1f} s: flying")
        stopping.flying = True
        record: TickRecord | None = None
        while not (stopping.requested or (options.ticks and server.ticks >= options.ticks)):
            record = server.tick()
            if server.ticks % _LINE_TICKS == 0:
                console.print(_line(record))
            if options.lockstep and all(v.silent and not v.armed for v in record.vehicles):
                break
        console.print(f"ended after {server.ticks} ticks")
    if record is not None:
        _raise_lost(record)


def runner_command(endpoint: Endpoint, pose: Pose, options: ServeOptions) -> str:
    """Return the command that flies a served drone from its launch pose."""
    words = ["imagine", "fly", "--vehicle", endpoint.vehicle, "--lidar", endpoint.lidar]
    if endpoint.mesh is not None:
        words += ["--mesh", endpoint.mesh]
    settings = {"drone_id": endpoint.drone, "launch.x": round(pose.x, 3), "launch.y": round(pose.y, 3)}
    if pose.yaw:
        settings["launch.yaw"] = round(pose.yaw, 4)
    words += [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    if options.lockstep:
        words += ["--set", "lockstep=true"]
    if options.twin.sensing.skew:
        words += ["--set", "odometry.deskew=true"]
    return shlex.join(words)


def _line(record: TickRecord) -> str:
    states = [
        f"D{v.drone} {v.mode.name.lower()} {v.height_m:.1f} m{' silent' if v.silent else ''}" for v in record.vehicles
    ]
    return f"{record.time_s:6.1f} s  " + "  ".join(states)


def _raise_lost(record: TickRecord) -> None:
    """Raise WorkError where a vehicle had to fail safe."""
    lost = [
        f"drone {v.drone}: {', '.join(f'{f.reason} at {f.time_s:.1f} s' for f in v.failsafes)}"
        for v in record.vehicles
        if v.failsafes
    ]
    if lost:
        raise WorkError("; ".join(lost))
