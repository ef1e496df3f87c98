"""The runner: what one drone does with one LiDAR scan. Everything else on board carries things to it and away.

`tick` is pure: no socket, no clock, no thread, no file. The same inputs give the same outputs, bit for bit, whether
they come from sockets in flight, from the twin in lockstep, or from a recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose, rotate
from imagine.core.frontier import FrontierField, frontier_field, own_distance
from imagine.core.lidar import Scan, mask_near
from imagine.core.observation import observe
from imagine.core.planner import plan_velocity
from imagine.core.shield import shield_velocity
from imagine.core.visits import VisitMap
from imagine.mesh_comm import messages
from imagine.mesh_comm.node import MeshNode
from imagine.onboard.flight import Flight, FlightStep
from imagine.onboard.ladder import STILL, Decider, Decision, Ladder, Order, Situation, Velocity
from imagine.onboard.perception import Perception, PerceptionResult
from imagine.onboard.phases import AIRBORNE, Phase
from imagine.onboard.places import PeerPlaces
from imagine.onboard.policy import Policy
from imagine.onboard.policy_decisions import PolicyDecisions
from imagine.onboard.records import Event, OdometryOut, RunnerStatus, Setpoint, Telemetry, TickInput, TickOutput
from imagine.onboard.settings import DroneSettings
from imagine.onboard.teammates import peer_poses
from imagine.onboard.yaw_prior import YawPrior


@dataclass(frozen=True)
class Mapped:
    """The team's belief after this tick: its frontier field, and how many cells the drone's own scan made known."""

    belief: NDArray[np.int8]
    field: FrontierField
    new_cells: int


@dataclass(frozen=True)
class Proposals:
    """What policy and planner would do, in the body frame; None with a reason where one has nothing to propose."""

    policy: Velocity | None
    policy_failure: str
    frontier: Velocity | None
    frontier_m: float


_NOTHING = Proposals(None, "", None, math.inf)
_OWN_HEIGHT_VARIANCE_M2 = 100.0
"""Of a height that is not a rangefinder's: the autopilot must not take its own estimate for a measurement."""
_ON_GROUND = Decision(Decider.HOLD, STILL, "on the ground")


class Runner:
    """One drone's mind: owns its perception, map, policy, ladder, phases and mesh node, and is moved only by `tick`."""

    def __init__(
        self,
        settings: DroneSettings,
        policy: Policy | None,
        perception: Perception,
        evidence: EvidenceMap,
        mesh: MeshNode | None,
    ) -> None:
        """Put the parts together; without a policy the frontier planner flies, without mesh the drone is alone."""
        self.settings = settings
        self.lidar = settings.lidar_spec
        self.decisions = None if policy is None else PolicyDecisions(policy)
        self.perception = perception
        self.evidence = evidence
        self.mesh = mesh
        sees_visits = policy is not None and policy.contract.observation.visits != "off"
        self.visits = VisitMap() if sees_visits else None
        self.ladder = Ladder(settings.ladder, settings.max_flight_s)
        self.flight = Flight(settings.flight)
        self.places = PeerPlaces()
        self._yaw_prior = YawPrior(settings.limits.yaw_rate_rps)
        self._where: PerceptionResult | None = None
        self._tracked_at: float | None = None
        self._reset_counter = 0
        self._order = Order.RESUME
        self._must_not_fly = ""
        self._decider = Decider.HOLD
        self._was_exploring = False
        self._events: list[Event] = []
        self.is_disarmed = True

    def tick(self, inputs: TickInput) -> TickOutput:
        """Turn one scan, or its absence, into what the drone does next. Without a fresh scan there is no setpoint."""
        self._events = []
        where = self._perceive(inputs)
        self._hear(inputs)
        mapped = self._map(where, inputs)
        proposals = self._propose(where, mapped, inputs)
        decision = self._decide(where, mapped, proposals, inputs)
        flight = self._fly(where, decision, inputs)
        setpoint = self._command(where, decision, flight, inputs)
        odometry = self._estimate(where, inputs)
        status = self._status(decision, flight, inputs)
        datagrams = self._speak(status, inputs)
        return TickOutput(setpoint, odometry, datagrams, flight.commands, status, tuple(self._events))

    def _perceive(self, inputs: TickInput) -> PerceptionResult | None:
        """Odometry and estimator; None without a scan newer than the last."""
        scan = inputs.scan
        if scan is None or (self._where is not None and scan.stamp <= self._where.stamp):
            return None
        was_lost = self._where is not None and self._where.lost
        where = self.perception.update(scan, self._yaw_prior.at(inputs.now, inputs.telemetry))
        if where.ok:
            self._tracked_at = inputs.now
            if was_lost:  # the pose jumped to where tracking found it again: tell the autopilot's estimator
                self._reset_counter = (self._reset_counter + 1) % 256
        self._where = where
        return where

    def _hear(self, inputs: TickInput) -> None:
        """Mesh inbox: peers' scans, tiles and states, and the pilot's orders."""
        if self.mesh is None:
            return
        for datagram in inputs.datagrams:
            self.mesh.receive(datagram, inputs.now)
        if self.mesh.has_namesake and not self._must_not_fly:
            # both write one map layer and answer to one name: neither's word is worth anything to the team
            self._must_not_fly = f"another node is on the air as drone {self.mesh.id}"
            self._tell(inputs.now, "failsafe", f"land: {self._must_not_fly}")
        for command in self.mesh.commands():
            if self._order is not Order.LAND:  # a landing stands
                self._order = Order(command.action)
            self._tell(inputs.now, "command", f"the pilot ordered {command.action}")

    def _map(self, where: PerceptionResult | None, inputs: TickInput) -> Mapped | None:
        """Own evidence, drawn without the teammates the LiDAR sees, then the frontiers of the team's belief."""
        if where is None:
            return None
        scan = where.scan
        belief = self.evidence.belief()
        new_cells = 0
        if where.ok:
            known = np.count_nonzero(belief)
            mates = np.zeros((0, 2)) if self.mesh is None else self.mesh.teammates(inputs.now)
            radius = self.settings.radio.mask_radius_m
            masked = Scan(scan.stamp, mask_near(scan.ranges, self.lidar, where.pose, mates, radius))
            try:
                self.evidence.integrate(where.pose, masked, self.lidar, self.settings.map.range_cap_m)
                if self.mesh is not None:
                    self.mesh.offer_scan(masked, where.pose, inputs.now)
            except InputError as error:  # an estimate far outside any map: lost, whatever it says of itself
                self._tracked_at = None
                self._tell(inputs.now, "error", str(error))
            belief = self.evidence.belief()
            new_cells = int(np.count_nonzero(belief) - known)
        if self.visits is not None:
            self.visits.fit(self.evidence.origin_cells, self.evidence.shape)
            if where.ok and self.flight.phase is Phase.EXPLORE:  # as in training, where time begins with exploring
                self.visits.count(where.pose.x, where.pose.y, peer_poses(self.mesh, inputs.now)[1])
        return Mapped(belief, frontier_field(belief), new_cells)

    def _propose(self, where: PerceptionResult | None, mapped: Mapped | None, inputs: TickInput) -> Proposals:
        """Ask the policy by its observation, and the planner by the frontier field."""
        scan = inputs.scan
        if where is None or mapped is None or scan is None:
            return _NOTHING
        pose, origin = where.pose, self.evidence.origin_cells
        wanted, failure = self._infer(where, mapped, scan, inputs.now)
        planned = plan_velocity(mapped.field, origin, pose, scan, self.lidar, self.settings.limits.speed_mps)
        frontier = None if planned is None else (*rotate(-pose.yaw, *planned), 0.0)
        return Proposals(wanted, failure, frontier, own_distance(mapped.field, origin, pose.x, pose.y))

    def _infer(self, where: PerceptionResult, mapped: Mapped, scan: Scan, now: float) -> tuple[Velocity | None, str]:
        if self.decisions is None:
            return None, "no policy: the frontier planner flies"
        spec = self.decisions.policy.contract.observation

        def look() -> dict[str, NDArray[np.float32]]:
            return observe(
                spec, mapped.belief, mapped.field, self.evidence.origin_cells, where.pose, where.velocity,
                where.yaw_rate, scan, self.lidar, peer_poses(self.mesh, now)[0], self.visits,
            )  # fmt: skip

        return self.decisions.next_velocity(look, where.pose, is_flying=self._decider is Decider.POLICY)

    def _decide(
        self, where: PerceptionResult | None, mapped: Mapped | None, proposals: Proposals, inputs: TickInput
    ) -> Decision:
        """The decision ladder, while airborne."""
        self._was_exploring = self.flight.phase is Phase.EXPLORE
        if self.flight.phase not in AIRBORNE:
            return _ON_GROUND
        now, telemetry, last = inputs.now, inputs.telemetry, self._where
        unseen = where is None
        decision = self.ladder.decide(
            Situation(
                now=now,
                pose=last.pose if last is not None else self.settings.launch.pose,
                policy=proposals.policy,
                policy_failure=proposals.policy_failure,
                frontier=proposals.frontier,
                frontier_m=proposals.frontier_m,
                new_cells=mapped.new_cells if mapped is not None else 0,
                lost_s=math.inf if self._tracked_at is None else now - self._tracked_at,
                lost_reason="no LiDAR scan" if last is None or unseen else last.reason or "odometry",
                silent_s=math.inf if telemetry is None else now - telemetry.stamp,
                battery=telemetry.battery if telemetry is not None else None,
                airborne_s=self.flight.airborne_s(now),
                order=self._order,
                must_land=self._must_not_fly,
                ending=inputs.ending,
                exploring=self._was_exploring,
                has_scan=not unseen,
                height_age_s=telemetry.height_age_s if telemetry is not None else 0.0,
            )
        )
        if decision.decider is not self._decider:
            self._decider = decision.decider
            kind = "failsafe" if decision.failsafe else "decision"
            self._tell(now, kind, f"{decision.decider.value}: {decision.reason}")
        return decision

    def _fly(self, where: PerceptionResult | None, decision: Decision, inputs: TickInput) -> FlightStep:
        """The phase machine: takeoff, flight, landing."""
        land_reason = decision.reason if decision.decider is Decider.LAND else None
        if self.flight.phase not in AIRBORNE:  # the ladder is not asked on the ground
            charge = inputs.telemetry.battery if inputs.telemetry is not None else None
            if self._must_not_fly:
                land_reason = self._must_not_fly
            elif inputs.ending:
                land_reason = "the runner was asked to end"
            elif self._order is Order.LAND:
                land_reason = "the pilot ordered landing"
            elif charge is not None and charge <= self.settings.ladder.battery_land:
                land_reason = f"battery at {charge:.0%}"
        step = self.flight.step(
            inputs.now,
            inputs.telemetry,
            tracked=where is not None and where.ok,
            land_reason=land_reason,
            may_start=self._order is not Order.HOLD,
        )
        self._events += step.events
        return step

    def _command(
        self, where: PerceptionResult | None, decision: Decision, flight: FlightStep, inputs: TickInput
    ) -> Setpoint | None:
        """The shielded setpoint; None (silence) without a fresh scan, or when the vehicle is another's."""
        scan = inputs.scan
        if where is None or scan is None or not flight.streams:
            return None
        if flight.phase not in (Phase.CLIMB, Phase.EXPLORE):
            return Setpoint()
        limits = self.settings.limits
        vx, vy, yaw_rate = decision.velocity if flight.phase is Phase.EXPLORE else STILL
        excess = max(1.0, math.hypot(vx, vy) / limits.speed_mps)
        vx, vy = shield_velocity(vx / excess, vy / excess, scan, self.lidar, limits)
        yaw_rate = max(-limits.yaw_rate_rps, min(limits.yaw_rate_rps, yaw_rate))
        if not all(map(math.isfinite, (vx, vy, flight.vz, yaw_rate))):
            self._tell(inputs.now, "error", "a setpoint that is not finite was replaced by hold")
            return Setpoint()
        return Setpoint(vx, vy, flight.vz, yaw_rate)

    def _estimate(self, where: PerceptionResult | None, inputs: TickInput) -> OdometryOut | None:
        """The pose for the autopilot; None once tracking is lost, so that it knows."""
        if where is None or where.lost or self._tracked_at is None:
            return None
        telemetry = inputs.telemetry or Telemetry(inputs.now)
        vx, vy = rotate(-where.pose.yaw, *where.velocity)
        variance = [float(v) for v in where.variance]
        return OdometryOut(
            stamp=where.stamp,
            pose=where.pose,
            height_m=telemetry.height_m,
            velocity=(vx, vy, telemetry.climb_mps),
            yaw_rate=where.yaw_rate,
            position_variance=max(variance[0], variance[1]),
            height_variance=max(variance[0], variance[1]) if telemetry.ranged else _OWN_HEIGHT_VARIANCE_M2,
            yaw_variance=variance[2],
            velocity_variance=max(variance[3], variance[4]),
            reset_counter=self._reset_counter,
        )

    def _status(self, decision: Decision, flight: FlightStep, inputs: TickInput) -> RunnerStatus:
        """Where the drone stands, in words for the pilot."""
        telemetry, where = inputs.telemetry, self._where
        self.is_disarmed = telemetry is not None and not telemetry.armed
        flying = self._was_exploring and flight.phase is Phase.EXPLORE
        return RunnerStatus(
            stamp=inputs.now,
            phase=flight.phase.value,
            decider=decision.decider.value if flying else flight.phase.value,
            reason=decision.reason if flying else flight.reason,
            mode=telemetry.mode.value if telemetry is not None else "",
            armed=telemetry is not None and telemetry.armed,
            tracked=where is not None and where.ok,
            pose=where.pose if where is not None else self.settings.launch.pose,
            velocity=where.velocity if where is not None else (0.0, 0.0),
            height_m=telemetry.height_m if telemetry is not None else 0.0,
            battery=telemetry.battery if telemetry is not None else None,
        )

    def _speak(self, status: RunnerStatus, inputs: TickInput) -> tuple[bytes, ...]:
        """Mesh outbox: state, scan, and the tiles that peers lack."""
        if self.mesh is None:
            return ()
        self.mesh.set_status(
            messages.Status(
                id=self.settings.drone_id,
                stamp=status.stamp,
                pose=Pose(*status.pose),
                velocity=status.velocity,
                height_m=status.height_m,
                battery=status.battery,
                mode=status.mode,
                armed=status.armed,
                ladder=status.decider,
                reason=status.reason,
            )
        )
        datagrams = tuple(self.mesh.poll(inputs.now))
        self._events += self.places.observe(self.mesh, inputs.now)  # polling is when frames are found
        return datagrams

    def _tell(self, now: float, kind: str, text: str) -> None:
        self._events.append(Event(now, kind, text))
