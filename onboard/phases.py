"""The names of a flight's phases, and the order in which one make of autopilot goes through them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Phase(StrEnum):
    """Where a flight stands. DISARM: taking back an arming that was asked for, without having flown.

    RELEASED: the autopilot or a pilot has the vehicle, the runner is silent for good.
    """

    PREPARE = "prepare"
    OFFBOARD = "offboard"
    ARM = "arm"
    DISARM = "disarm"
    CLIMB = "climb"
    EXPLORE = "explore"
    LAND = "land"
    DONE = "done"
    RELEASED = "released"
    FAILED = "failed"


AIRBORNE = frozenset({Phase.CLIMB, Phase.EXPLORE, Phase.LAND})
FINAL = frozenset({Phase.DONE, Phase.RELEASED, Phase.FAILED})


@dataclass(frozen=True)
class Takeoff:
    """How one make of autopilot is brought into the air: the phases in order, the stream it wants before OFFBOARD.

    PX4 takes OFFBOARD only with setpoints streaming, arms in it, and climbs by velocity.
    """

    phases: tuple[Phase, ...]
    needs_stream: bool


TAKEOFFS: dict[str, Takeoff] = {
    "px4": Takeoff((Phase.PREPARE, Phase.OFFBOARD, Phase.ARM, Phase.CLIMB, Phase.EXPLORE), needs_stream=True),
}
