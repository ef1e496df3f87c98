"""The vehicle's parameters: the few that change its behaviour, and those a companion checks before it flies."""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from imagine.sim.flight_control import VehicleSettings

INT32, REAL32 = int(mavlink.MAV_PARAM_TYPE_INT32), int(mavlink.MAV_PARAM_TYPE_REAL32)


class Param(NamedTuple):
    """One parameter: MAV_PARAM_TYPE (INT32 or REAL32) and value."""

    kind: int
    value: float


def px4_params(settings: VehicleSettings) -> dict[str, Param]:
    """Return the parameter table of a PX4 set up to fly on external odometry, without GPS and compass."""
    table = {
        "COM_DISARM_LAND": Param(REAL32, 2.0),
        "COM_OBL_RC_ACT": Param(INT32, 5),  # land when the offboard stream is lost
        "COM_OF_LOSS_T": Param(REAL32, settings.offboard_loss_s),
        "EKF2_EV_CTRL": Param(INT32, 15),
        "EKF2_GPS_CTRL": Param(INT32, 0),
        "EKF2_HGT_REF": Param(INT32, 3),
        "EKF2_MAG_TYPE": Param(INT32, 5),
        "MIS_TAKEOFF_ALT": Param(REAL32, settings.takeoff_height_m),
        "MPC_LAND_SPEED": Param(REAL32, settings.land_mps),
        "SYS_HAS_GPS": Param(INT32, 0),
        "SYS_HAS_MAG": Param(INT32, 0),
    }
    return dict(sorted(table.items()))


def to_wire(param: Param) -> float:
    """Return PARAM_VALUE.param_value: PX4 puts the bytes of an integer where the float is."""
    if param.kind == INT32:
        return float(struct.unpack("<f", struct.pack("<i", int(param.value)))[0])
    return param.value


def from_wire(kind: int, raw: float) -> float | None:
    """Read PARAM_SET.param_value of a parameter of type `kind`; None when it is not a finite number."""
    if kind == INT32:
        return float(struct.unpack("<i", struct.pack("<f", raw))[0])
    return raw if math.isfinite(raw) else None
