"""What a drone's operator can set: who it is, how it is wired, how it flies."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, field_validator

from imagine.core.config import Settings
from imagine.core.frames import Pose
from imagine.core.lidar import PRESETS, LidarSpec
from imagine.core.mapping import MapSettings
from imagine.core.vehicle_limits import VehicleLimits
from imagine.mesh_comm.settings import MeshSettings
from imagine.onboard.odometry_settings import OdometrySettings

DEFAULT_POLICY = Path(__file__).parent / "policies" / "default.onnx"
"""The policy that is shipped with the project."""


class LaunchPose(Settings):
    """Where a drone stands at the start, in the map frame its team shares; metres and radians."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    @property
    def pose(self) -> Pose:
        """Return it as a pose."""
        return Pose(self.x, self.y, self.yaw)


class FlightSettings(Settings):
    """Heights, speeds and deadlines of a flight's phases."""

    height_m: float = Field(default=1.0, gt=0.2, le=10.0, description="flight height above the launch point")
    climb_mps: float = Field(default=0.6, gt=0.0, le=2.0)
    height_gain: float = Field(default=1.0, gt=0.0, le=5.0, description="climb speed per metre of height error, 1/s")
    stream_s: float = Field(default=1.0, ge=0.0, le=10.0, description="setpoints sent before OFFBOARD is requested")
    retry_s: float = Field(default=1.0, gt=0.0, description="between repeated requests to the autopilot")
    ready_deadline_s: float = Field(default=60.0, gt=0.0, description="to hear the vehicle and to track the scans")
    offboard_deadline_s: float = Field(default=10.0, gt=0.0)
    arm_deadline_s: float = Field(default=20.0, gt=0.0)
    climb_deadline_s: float = Field(default=15.0, gt=0.0)
    land_deadline_s: float = Field(default=30.0, gt=0.0)


class LadderSettings(Settings):
    """When the decision ladder steps down, and back up; seconds, metres, battery in 0..1."""

    stuck_still_s: float = Field(default=4.0, gt=0.0, description="moved less than `stuck_still_m` for so long: stuck")
    stuck_still_m: float = Field(default=0.3, gt=0.0)
    stuck_aimless_s: float = Field(default=8.0, gt=0.0, description="no frontier nearer and nothing new seen: stuck")
    stuck_nearer_m: float = Field(default=0.5, gt=0.0)
    stuck_new_cells: int = Field(default=30, gt=0)
    rescue_s: float = Field(default=5.0, gt=0.0, description="longest first rescue; it doubles while rescues repeat")
    rescue_longest_s: float = Field(default=20.0, gt=0.0)
    rescue_travel_m: float = Field(default=1.5, gt=0.0, description="travelled so far: the policy gets it back")
    explored_s: float = Field(default=2.0, gt=0.0, description="no frontier in reach for so long: explored, land")
    lost_hold_s: float = Field(default=0.5, gt=0.0, description="odometry, scans or telemetry lost: hold")
    lost_land_s: float = Field(default=3.0, gt=0.0, description="lost for so long: land")
    battery_land: float = Field(default=0.15, ge=0.0, le=1.0, description="land at or below this charge")


class DroneSettings(Settings):
    """One drone, ready to fly. URLs are `udpin://host:port` (listen) or `udpout://host:port` (send to)."""

    drone_id: int = Field(default=1, ge=1, le=250)
    vehicle: str = "udpin://127.0.0.1:14541"
    vehicle_system: int | None = Field(default=None, ge=1, le=255, description="MAVLink system; None: the drone's id")
    lidar: str = "udpin://127.0.0.1:15541"
    lidar_preset: str = "ld19"
    mesh: str | None = None
    key_file: Path | None = Field(default=None, description="the swarm's key; None: environment IMAGINE_MESH_KEY")
    boot_file: Path | None = Field(
        default=None, description="remembers the mesh's boot number between starts; None: ~/.imagine/drone-ID.boot"
    )
    radio: MeshSettings = MeshSettings()
    policy: Path | None = Field(default=DEFAULT_POLICY, description="ONNX file; None: the frontier planner flies")
    launch: LaunchPose = LaunchPose()
    limits: VehicleLimits = VehicleLimits()
    map: MapSettings = MapSettings()
    odometry: OdometrySettings = OdometrySettings()
    flight: FlightSettings = FlightSettings()
    ladder: LadderSettings = LadderSettings()
    lockstep: bool = False
    stay: bool = Field(default=False, description="keep running (relaying maps) after landing, until told to end")
    max_flight_s: float = Field(default=600.0, gt=0.0, description="in the air for so long: land")
    silence_s: float = Field(default=20.0, gt=0.0, description="no scan for so long, wall clock: give up")
    report: Path | None = None
    map_out: Path | None = None

    @field_validator("lidar_preset")
    @classmethod
    def _known_preset(cls, name: str) -> str:
        if name not in PRESETS:
            raise ValueError(f"unknown LiDAR; known: {', '.join(PRESETS)}")
        return name

    @property
    def lidar_spec(self) -> LidarSpec:
        """The drone's sensor."""
        return PRESETS[self.lidar_preset]

    @property
    def system(self) -> int:
        """The vehicle's MAVLink system id."""
        return self.vehicle_system if self.vehicle_system is not None else self.drone_id
