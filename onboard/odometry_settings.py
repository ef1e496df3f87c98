"""What can be set about odometry, apart from it: reading settings must not load the libraries that match scans."""

from __future__ import annotations

from pydantic import Field

from imagine.core.config import Settings


class OdometrySettings(Settings):
    """How scans are matched, and what counts as having lost track. The defaults are measured on planar scans."""

    voxel_m: float = Field(default=0.5, gt=0.0, description="side of a voxel of the local map, metres")
    points_per_voxel: int = Field(
        default=20, ge=1, description="map points in a voxel; at 100 a sensor noise of 3 cm drifts ten times as far"
    )
    source_voxel_m: float = Field(default=0.15, gt=0.0, description="scans are thinned to this before matching, metres")
    threshold_m: float = Field(default=0.25, gt=0.0, description="ICP kernel; pairs up to three times this are matched")
    map_radius_m: float = Field(default=50.0, gt=0.0, description="points farther than this are forgotten, metres")
    max_iterations: int = Field(default=500, ge=1)
    convergence: float = Field(default=1e-4, gt=0.0)
    min_points: int = Field(default=12, ge=3, description="fewer thinned points than this cannot be matched")
    min_overlap: float = Field(default=0.5, ge=0.0, le=1.0, description="share of a scan that must meet the last one")
    overlap_distance_m: float = Field(default=0.2, gt=0.0, description="points this close count as meeting")
    max_correction_m: float = Field(default=0.5, gt=0.0, description="a match farther from the guess is wrong")
    max_speed_mps: float = Field(default=5.0, gt=0.0, description="a faster motion is a wrong match")
    max_yaw_error_rad: float = Field(default=0.35, gt=0.0, description="largest disagreement with the yaw prior")
    deskew: bool = Field(
        default=False, description="beams come one after another: put each where the end of the turn would have seen it"
    )
    clockwise: bool = Field(default=False, description="for deskewing: the sensor turns clockwise, as seen from above")
