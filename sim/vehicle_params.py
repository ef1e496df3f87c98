"""The vehicle's parameters: the few that change its behaviour, and those a companion checks before it flies."""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from imagine.sim.flight_control import VehicleSettings
from imagine.sim.vehicle_messages import Message

INT32, REAL32 = int(mavlink.MAV_PARAM_TYPE_INT32), int(mavlink.MAV_PARAM_TYPE_REAL32)
OFFBOARD_LOSS, TAKEOFF_HEIGHT = "COM_OF_LOSS_T", "MIS_TAKEOFF_ALT"


class Param(NamedTuple):
    """One parameter: MAV_PARAM_TYPE (INT32 or REAL32) and value."""

    kind: int
    value: float


class ParamTable:
    """The parameters of a PX4 set up to fly on external odometry, without GPS and compass, and their protocol."""

    def __init__(self, settings: VehicleSettings) -> None:
        """Take the values that the settings give."""
        self._params = {
            "COM_DISARM_LAND": Param(REAL32, 2.0),
            "COM_OBL_RC_ACT": Param(INT32, 5),  # land when the offboard stream is lost
            OFFBOARD_LOSS: Param(REAL32, settings.offboard_loss_s),
            "EKF2_EV_CTRL": Param(INT32, 15),
            "EKF2_GPS_CTRL": Param(INT32, 0),
            "EKF2_HGT_REF": Param(INT32, 3),
            "EKF2_MAG_TYPE": Param(INT32, 5),
            TAKEOFF_HEIGHT: Param(REAL32, settings.takeoff_height_m),
            "MPC_LAND_SPEED": Param(REAL32, settings.land_mps),
            "SYS_HAS_GPS": Param(INT32, 0),
            "SYS_HAS_MAG": Param(INT32, 0),
        }

    def __getitem__(self, name: str) -> float:
        return self._params[name].value

    def answer_list(self) -> list[Message]:
        """Answer PARAM_REQUEST_LIST."""
        return [self._value(name) for name in self._params]

    def answer_read(self, m: Message) -> list[Message]:
        """Answer PARAM_REQUEST_READ; like PX4, say nothing about what it does not have."""
        names = list(self._params)
        name = _name(m) if m.param_index < 0 else "".join(names[m.param_index : m.param_index + 1])
        return [self._value(name)] if name in self._params else []

    def answer_set(self, m: Message) -> tuple[list[Message], str | None]:
        """Carry out PARAM_SET; return the answer, and the reason if it could not be done."""
        name = _name(m)
        if name not in self._params:
            return [], "unknown parameter"
        kind = self._params[name].kind
        value = _from_wire(kind, m.param_value) if m.param_type == kind else None
        if value is not None:
            self._params[name] = Param(kind, value)
        return [self._value(name)], "parameter value" if value is None else None

    def _value(self, name: str) -> Message:
        param, index = self._params[name], list(self._params).index(name)
        return mavlink.MAVLink_param_value_message(name.encode(), _to_wire(param), param.kind, len(self._params), index)


def _to_wire(param: Param) -> float:
    """Return PARAM_VALUE.param_value: PX4 puts the bytes of an integer where the float is."""
    if param.kind == INT32:
        return float(struct.unpack("<f", struct.pack("<i", int(param.value)))[0])
    return param.value


def _from_wire(kind: int, raw: float) -> float | None:
    """Read PARAM_SET.param_value of a parameter of type `kind`; None when it is not a finite number."""
    if kind == INT32:
        return float(struct.unpack("<i", struct.pack("<f", raw))[0])
    return raw if math.isfinite(raw) else None


def _name(m: Message) -> str:
    name = m.param_id
    return (name.decode("ascii", "replace") if isinstance(name, bytes) else str(name)).rstrip("\x00")
