"""The decision ladder: policy → frontier rescue → hold → land. Each step down has a reason that the pilot sees.

Pure: it is told what is known and says who decides, with which velocity. It never climbs back from land.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from imagine.core.frames import Pose
from imagine.onboard.progress import ProgressWatch
from imagine.onboard.settings import LadderSettings

Velocity = tuple[float, float, float]
"""Body frame: forward and left in m/s, yaw rate in rad/s."""

STILL: Velocity = (0.0, 0.0, 0.0)


class Decider(StrEnum):
    """The rungs, highest first."""

    POLICY = "policy"
    FRONTIER = "frontier"
    HOLD = "hold"
    LAND = "land"


class Order(StrEnum):
    """What the pilot last asked for; RESUME takes a hold back, a landing stands."""

    RESUME = "resume"
    HOLD = "hold"
    LAND = "land"


@dataclass(frozen=True)
class Situation:
    """What the ladder decides on. Times in seconds, distances in metres, battery in 0..1 (None: unknown).

    `policy` and `frontier` are the velocities the two propose; None: the policy failed (`policy_failure` says how) or
    is absent, no frontier is in reach. `lost_s`: since a scan was last tracked. `silent_s`: age of the telemetry.
    `height_age_s`: since a rangefinder that had been heard fell silent. `must_land`: why the flight may not go on.
    """

    now: float
    pose: Pose
    policy: Velocity | None
    policy_failure: str
    frontier: Velocity | None
    frontier_m: float
    new_cells: int
    lost_s: float
    lost_reason: str
    silent_s: float
    battery: float | None
    airborne_s: float
    order: Order
    ending: bool = False
    exploring: bool = True
    has_scan: bool = True
    height_age_s: float = 0.0
    must_land: str = ""


@dataclass(frozen=True)
class Decision:
    """Who decides this tick, with which velocity, and why. `failsafe`: it is a fault that made the ladder step down."""

    decider: Decider
    velocity: Velocity
    reason: str
    failsafe: bool = False


class Ladder:
    """The ladder of one flight: remembers rescues, the last frontier, and a landing once decided."""

    def __init__(self, settings: LadderSettings, max_flight_s: float = math.inf) -> None:
        """Start with trust in the policy."""
        self.settings = settings
        self.max_flight_s = max_flight_s
        self._progress = ProgressWatch(settings)
        self._landing: Decision | None = None
        self._no_frontier_since: float | None = None
        self._rescue: _Rescue | None = None
        self._rescues_in_a_row = 0
        self._rescued_at = -math.inf

    def decide(self, s: Situation) -> Decision:
        """Return this tick's decision; call it once a tick while airborne."""
        if self._landing is None:
            self._landing = self._must_land(s)
        if self._landing is not None:
            return self._landing
        held = self._must_hold(s)
        if held is not None:
            self._rescue = self._no_frontier_since = None
            self._progress.restart()
            return held
        if not s.has_scan:  # what the drone does not see it cannot judge: no timer runs
            return Decision(Decider.HOLD, STILL, "waiting for a scan")
        if s.frontier is None:
            return self._without_frontier(s)
        self._no_frontier_since = None
        return self._explore(s, s.frontier)

    def _must_land(self, s: Situation) -> Decision | None:
        c = self.settings
        if s.must_land:
            return Decision(Decider.LAND, STILL, s.must_land, failsafe=True)
        if s.order is Order.LAND:
            return Decision(Decider.LAND, STILL, "the pilot ordered landing")
        if s.ending:
            return Decision(Decider.LAND, STILL, "the runner was asked to end")
        if s.battery is not None and s.battery <= c.battery_land:
            return Decision(Decider.LAND, STILL, f"battery at {s.battery:.0%}", failsafe=True)
        if s.lost_s > c.lost_land_s:
            return Decision(Decider.LAND, STILL, f"lost for {s.lost_s:.1f} s: {s.lost_reason}", failsafe=True)
        if s.silent_s > c.lost_land_s:
            return Decision(Decider.LAND, STILL, f"no telemetry for {s.silent_s:.1f} s", failsafe=True)
        if s.height_age_s > c.lost_land_s:
            return Decision(Decider.LAND, STILL, f"no height for {s.height_age_s:.1f} s", failsafe=True)
        if s.airborne_s > self.max_flight_s:
            return Decision(Decider.LAND, STILL, f"flown for {self.max_flight_s:.0f} s, the longest allowed")
        return None

    def _must_hold(self, s: Situation) -> Decision | None:
        c = self.settings
        if s.lost_s > c.lost_hold_s:
            return Decision(Decider.HOLD, STILL, f"lost for {s.lost_s:.1f} s: {s.lost_reason}")
        if s.silent_s > c.lost_hold_s:
            return Decision(Decider.HOLD, STILL, f"no telemetry for {s.silent_s:.1f} s")
        if s.order is Order.HOLD:
            return Decision(Decider.HOLD, STILL, "the pilot ordered hold")
        if not s.exploring:
            return Decision(Decider.HOLD, STILL, "not yet exploring")
        return None

    def _without_frontier(self, s: Situation) -> Decision:
        self._progress.restart()
        self._rescue = None
        if self._no_frontier_since is None:
            self._no_frontier_since = s.now
        waited = s.now - self._no_frontier_since
        if waited >= self.settings.explored_s - 1e-6:
            self._landing = Decision(Decider.LAND, STILL, "area explored")
            return self._landing
        return Decision(Decider.HOLD, STILL, "no frontier in reach: is the area explored?")

    def _explore(self, s: Situation, frontier: Velocity) -> Decision:
        stuck = self._progress.stuck(s.now, s.pose.x, s.pose.y, s.frontier_m, s.new_cells)
        if self._rescue is not None and self._rescue.over(s.now, s.pose):
            self._rescue, self._rescued_at = None, s.now
            self._progress.restart()
            stuck = None
        if s.policy is None:
            return Decision(Decider.FRONTIER, frontier, s.policy_failure)
        if self._rescue is None and stuck is not None:
            self._rescue = self._begin_rescue(s, stuck)
        if self._rescue is not None:
            return Decision(Decider.FRONTIER, frontier, self._rescue.reason)
        return Decision(Decider.POLICY, s.policy, "exploring")

    def _begin_rescue(self, s: Situation, reason: str) -> _Rescue:
        """Start a rescue; one that follows soon on another lasts twice as long."""
        c = self.settings
        soon = s.now - self._rescued_at < 2.0 * c.stuck_aimless_s
        self._rescues_in_a_row = self._rescues_in_a_row + 1 if soon else 0
        stretch = 2.0**self._rescues_in_a_row
        return _Rescue(
            reason=f"policy stuck: {reason}",
            until=s.now + min(c.rescue_s * stretch, c.rescue_longest_s),
            travel_m=c.rescue_travel_m * stretch,
            at=s.pose,
        )


@dataclass
class _Rescue:
    """A bounded time with the planner: it ends after so long or so far, whichever comes first."""

    reason: str
    until: float
    travel_m: float
    at: Pose
    travelled_m: float = 0.0

    def over(self, now: float, pose: Pose) -> bool:
        """Take this tick's pose; tell whether the policy gets the drone back."""
        self.travelled_m += math.hypot(pose.x - self.at.x, pose.y - self.at.y)
        self.at = pose
        return now >= self.until - 1e-6 or self.travelled_m >= self.travel_m
