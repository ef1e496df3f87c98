"""What a policy sees: a versioned description that training, export and flight share."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from imagine.core.config import Settings
from imagine.core.raster import CELL


class ObservationSpec(Settings):
    """Egocentric views of the belief at several scales, pooled LiDAR ranges and the drone's own motion.

    Views have two channels a scale, occupancy and relative distance to the nearest frontier, in the order
    `(scale 0 occupancy, scale 0 frontier, scale 1 occupancy, ...)`. Row 0 is the lowest y, column 0 the lowest x.
    `axes` says how views, LiDAR sectors, velocity and a plane action are turned: along the map's axes or the heading.
    """

    version: Literal[1] = 1
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

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each input of the policy, by name, without the batch axis; all are float32."""
        return {
            "views": (2 * len(self.view_scales_m), self.view_cells, self.view_cells),
            "lidar": (self.lidar_sectors,),
            "motion": (3,),
        }
