"""What a policy sees: a versioned description that training, export and flight share."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from imagine.core.config import Settings
from imagine.core.frontier_choice import FRONTIER_NUMBERS
from imagine.core.raster import CELL

_OPTIONS = ("position", "heading", "peers", "peer_places", "frontiers", "visits")


class ObservationSpec(Settings):
    """Egocentric views of the belief at several scales, pooled LiDAR ranges, the drone's own motion, and options.

    Views have two channels a scale, occupancy and relative distance to the nearest frontier, in the order
    `(scale 0 occupancy, scale 0 frontier, scale 1 occupancy, ...)`. Row 0 is the lowest y, column 0 the lowest x.
    `axes` says how views, LiDAR sectors, velocity and the action are turned: along the map's axes or the heading.

    Options, all off by default, make it version 2. `visits` appends view channels, one a scale (`self`) or two
    (`team`: self, peers). To `motion` are appended, in this order: `position`, x and y in the map, along the map's axes
    whatever `axes` says; `heading`, cosine and sine of the yaw in the map; `peers`, that many distances, nearest first;
    `peer_places`, for that many peers, nearest first, two offsets along `axes` and how fresh the report is.
    `frontiers` adds an input of its own: that many frontiers, each as `frontier_choice.fill_frontiers` describes it.
    """

    version: Literal[1, 2] = Field(default=1, description="2 where an option is on; may be left out")
    view_cells: int = Field(default=32, ge=8, le=128, multiple_of=2)
    view_scales_m: tuple[float, ...] = Field(default=(0.1, 0.4), min_length=1, max_length=4)
    frontier_ranges_m: tuple[float, ...] = Field(
        default=(1.0, 4.0), description="difference of frontier distance, per scale, that reads as 1; metres"
    )
    lidar_sectors: int = Field(default=64, ge=4, le=720)
    lidar_range_m: float = Field(default=4.0, gt=0.0, description="range that reads as 1, metres")
    speed_mps: float = Field(default=0.8, gt=0.0, description="speed that reads as 1")
    yaw_rate_rps: float = Field(default=3.0, gt=0.0, description="yaw rate that reads as 1")
    axes: Literal["map", "heading"] = "map"
    position: bool = Field(default=False, description="see the drone's own position in the map")
    position_extent_m: float = Field(default=10.0, gt=0.0, description="coordinate that reads as 1, metres")
    heading: bool = Field(
        default=False, description="see the drone's own yaw: to turn by, with the map's axes, or to use the position"
    )
    peers: int = Field(default=0, ge=0, le=15, description="so many distances to the nearest known peers are seen")
    peers_range_m: float = Field(default=10.0, gt=0.0, description="distance to a peer that reads as 1, metres")
    peer_places: int = Field(default=0, ge=0, le=15, description="so many nearest peers are seen where they were heard")
    peer_places_range_m: float = Field(default=10.0, gt=0.0, description="offset to a peer that reads as 1, metres")
    peer_memory_s: float = Field(default=60.0, gt=0.0, description="reports older than this are forgotten")
    frontiers: int = Field(default=0, ge=0, le=32, description="so many frontiers to choose from are seen, best first")
    visits: Literal["off", "self", "team"] = Field(
        default="off", description="see how long this drone, or it and its peers, have been where"
    )
    visits_full_ticks: int = Field(default=100, ge=1, le=65535, description="ticks in a 0.2 m cell that read as 1")

    @model_validator(mode="before")
    @classmethod
    def _version_of_options(cls, data: Any) -> Any:
        if isinstance(data, dict) and "version" not in data:
            options = {name: cls.model_fields[name].default for name in _OPTIONS}
            if any(data.get(name, off) != off for name, off in options.items()):
                return {**data, "version": 2}
        return data

    @field_validator("view_scales_m")
    @classmethod
    def _whole_cells(cls, scales: tuple[float, ...]) -> tuple[float, ...]:
        for scale in scales:
            if scale not in (0.1, 0.2, 0.4, 0.8):
                raise ValueError(f"a view scale is one of 0.1, 0.2, 0.4, 0.8 m, got {scale} (a cell is {CELL} m)")
        return scales

    @model_validator(mode="after")
    def _one_range_a_scale(self) -> Self:
        if len(self.frontier_ranges_m) != len(self.view_scales_m):
            raise ValueError("frontier_ranges_m needs one range for each of view_scales_m")
        return self

    @model_validator(mode="after")
    def _options_need_version_2(self) -> Self:
        on = [name for name in _OPTIONS if getattr(self, name) != type(self).model_fields[name].default]
        if on and self.version == 1:
            raise ValueError(f"version 1 knows no {on[0]}: say version 2, or leave version out")
        return self

    @property
    def visit_channels(self) -> int:
        """View channels of visits for each scale."""
        return {"off": 0, "self": 1, "team": 2}[self.visits]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each input of the policy, by name, without the batch axis; all are float32."""
        shapes: dict[str, tuple[int, ...]] = {
            "views": ((2 + self.visit_channels) * len(self.view_scales_m), self.view_cells, self.view_cells),
            "lidar": (self.lidar_sectors,),
            "motion": (3 + 2 * self.position + 2 * self.heading + self.peers + 3 * self.peer_places,),
        }
        if self.frontiers:
            shapes["frontiers"] = (self.frontiers, FRONTIER_NUMBERS)
        return shapes
