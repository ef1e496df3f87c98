"""What the airframe can do: the limits that the twin obeys, the shield relies on, and the contract records."""

from __future__ import annotations

from pydantic import Field

from imagine.core.config import Settings


class VehicleLimits(Settings):
    """A small quadrotor's size and limits, SI units. Defaults are of the Tello class."""

    radius_m: float = Field(default=0.08, gt=0.0, le=1.0, description="radius of the circle that holds the airframe")
    speed_mps: float = Field(default=0.8, gt=0.0, le=10.0, description="greatest horizontal speed commanded")
    yaw_rate_rps: float = Field(default=3.0, gt=0.0, le=10.0, description="greatest yaw rate commanded")
    acceleration_mps2: float = Field(default=2.0, gt=0.0, le=30.0, description="greatest horizontal acceleration")
    lag_s: float = Field(default=0.15, ge=0.0, le=2.0, description="time constant from setpoint to velocity")
