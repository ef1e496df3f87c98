"""What can be set about a swarm's radio use; all drones of a swarm share these settings."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from imagine.core.config import Settings
from imagine.core.lidar import TEAMMATE_RADIUS_M

Protocol = Literal["off", "one-hop", "multi-hop"]
"""`off`: status only (the ground is still served); `one-hop`: own scans and tiles; `multi-hop`: relays too."""


class MeshSettings(Settings):
    """Protocol, byte budget and periods of one mesh node. Seconds, metres, bytes."""

    protocol: Protocol = "one-hop"
    rate_bytes_per_s: float = Field(default=31250.0, gt=0.0, description="bytes a second this node may send, sealed")
    burst_bytes: float = Field(default=6250.0, ge=1200.0, description="bytes it may send at once after a silence")
    status_period_s: float = Field(default=0.5, gt=0.0)
    digest_period_s: float = Field(default=0.5, gt=0.0)
    scan_period_s: float = Field(default=0.1, gt=0.0, description="at most one scan is sent per period")
    tile_period_s: float = Field(default=1.0, gt=0.0, description="the same tile is sent at most once per period")
    peer_timeout_s: float = Field(default=2.0, gt=0.0, description="a peer silent for longer is out of reach")
    mask_radius_m: float = Field(
        default=TEAMMATE_RADIUS_M, ge=0.0, description="returns this close to a teammate are not mapped"
    )
    command_repeat_s: float = Field(default=2.0, ge=0.0, description="the ground repeats a command for so long")
    max_sources: int = Field(default=32, ge=1, le=254, description="most drones whose maps are kept: bounds memory")
