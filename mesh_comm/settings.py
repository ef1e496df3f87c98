"""What can be set about a swarm's radio use; all drones of a swarm share these settings."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from imagine.core.config import Settings
from imagine.core.frames import Pose
from imagine.core.lidar import TEAMMATE_RADIUS_M
from imagine.mesh_comm.alignment import AlignmentSettings

Protocol = Literal["off", "one-hop", "multi-hop"]
"""`off`: status only (the ground is still served); `one-hop`: own scans and tiles; `multi-hop`: relays too."""

Scheduler = Literal["information", "fifo"]
"""What goes first where bytes are short. `information`: what tells peers most new cells a byte; `fifo`: what waited
longest, which only comparisons need."""

Frame = Literal["shared", "layout", "unknown"]
"""`shared`: all drones map in one frame; `layout`: each in its own, begun where `layout` says; `unknown`: each in its
own, found out from the maps."""


class MeshSettings(Settings):
    """Protocol, byte budget and periods of one mesh node. Seconds, metres, bytes."""

    protocol: Protocol = "one-hop"
    rate_bytes_per_s: float = Field(default=31250.0, gt=0.0, description="bytes a second this node may send, sealed")
    burst_bytes: float = Field(default=6250.0, ge=1200.0, description="bytes it may send at once after a silence")
    scheduler: Scheduler = "information"
    status_period_s: float = Field(default=1.0, gt=0.0)
    pose_period_s: float = Field(default=0.5, gt=0.0, description="at least once a period a drone tells where it is")
    near_m: float = Field(default=3.0, ge=0.0, description="a peer this close is near")
    near_pose_period_s: float = Field(default=0.2, gt=0.0, description="and as often while a peer is near")
    digest_period_s: float = Field(default=0.5, gt=0.0)
    scan_period_s: float = Field(default=0.1, gt=0.0, description="at most one scan is sent per period")
    tile_period_s: float = Field(default=1.0, gt=0.0, description="the same tile is sent at most once per period")
    peer_timeout_s: float = Field(default=2.0, gt=0.0, description="a peer silent for longer is out of reach")
    mask_radius_m: float = Field(
        default=TEAMMATE_RADIUS_M, ge=0.0, description="returns this close to a teammate are not mapped"
    )
    command_repeat_s: float = Field(default=2.0, ge=0.0, description="the ground repeats a command for so long")
    max_sources: int = Field(default=32, ge=1, le=254, description="most drones whose maps are kept: bounds memory")
    frame: Frame = "shared"
    layout: dict[int, tuple[float, float, float]] = Field(
        default={}, description="where each drone's frame begins: x, y, metres, and yaw, radians, in a common frame"
    )
    alignment: AlignmentSettings = AlignmentSettings()

    @property
    def launches(self) -> dict[int, Pose]:
        """The layout as poses, by drone; empty unless `frame` is `layout`."""
        return {drone: Pose(*pose) for drone, pose in self.layout.items()} if self.frame == "layout" else {}

    @model_validator(mode="after")
    def _has_layout(self) -> Self:
        if (self.frame == "layout") != bool(self.layout):
            raise ValueError("frame 'layout' needs a layout, and a layout needs frame 'layout'")
        return self
