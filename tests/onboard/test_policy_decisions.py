"""A policy's options in flight: decisions that stand, waypoints, peers told of by radio, and visits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flat_world import FlatFlight, make_runner
from tiny_policy import make_contract

from imagine.core.contract import ActionSpec
from imagine.core.errors import WorkError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import LD19
from imagine.core.observation_spec import ObservationSpec
from imagine.mesh_comm import messages
from imagine.mesh_comm.node import MeshNode
from imagine.mesh_comm.seal import Sealer
from imagine.onboard.policy_decisions import PolicyDecisions
from imagine.onboard.settings import DroneSettings, LaunchPose

SETTINGS = DroneSettings(policy=None, launch=LaunchPose(x=1.5, y=1.5))
KEY = bytes(range(32))
HERE = Pose(0.0, 0.0, 0.0)
STANDING = ActionSpec(mode="waypoint", decision_ticks=5)


class Answers:
    """A policy that goes through its answers, one a question, the last for ever; a text is a failure."""

    def __init__(self, *answers, **contract) -> None:
        self.contract = make_contract(**contract)
        self.answers = list(answers)
        self.seen: list[dict[str, np.ndarray]] = []

    def infer(self, observation, state):
        self.seen.append(observation)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, str):
            raise WorkError(answer)
        return np.array(answer, np.float32), state


def exploring(flight: FlatFlight):
    return flight.fly_until(lambda output: output.status.decider == "policy", longest_s=10.0)


def test_a_decision_is_asked_for_once_and_stands_for_its_ticks():
    policy = Answers((1.0, 0.0), (0.0, 1.0), action=ActionSpec(decision_ticks=3))
    decisions = PolicyDecisions(policy)
    wanted = [decisions.next_velocity(dict, HERE, is_flying=True)[0] for _ in range(6)]
    assert wanted == [(0.8, 0.0, 0.0)] * 3 + [(0.0, 0.8, 0.0)] * 3
    assert len(policy.seen) == 2


def test_while_another_flies_every_tick_is_decided_anew():
    policy = Answers((1.0, 0.0), action=ActionSpec(decision_ticks=10))
    decisions = PolicyDecisions(policy)
    for flying, asked in ((False, 1), (False, 2), (True, 2), (True, 2), (False, 3), (True, 3)):
        decisions.next_velocity(dict, HERE, is_flying=flying)
        assert len(policy.seen) == asked


def test_a_failure_does_not_stand():
    decisions = PolicyDecisions(Answers("out of memory", (1.0, 0.0), action=ActionSpec(decision_ticks=3)))
    assert decisions.next_velocity(dict, HERE, is_flying=True) == (None, "out of memory")
    assert decisions.next_velocity(dict, HERE, is_flying=True) == ((0.8, 0.0, 0.0), "")


def test_a_waypoint_stays_where_it_is_in_the_map():
    decisions = PolicyDecisions(Answers((0.5, 0.0), action=STANDING, observation=ObservationSpec(view_cells=16)))
    speeds = []
    for x in (0.0, 0.5, 0.9, 1.0, 1.1):  # 1 m ahead, and then behind
        velocity, _ = decisions.next_velocity(dict, Pose(x, 0.0, 0.0), is_flying=True)
        speeds.append(velocity[0])
    assert speeds[0] == 0.8
    assert 0.8 > speeds[1] > speeds[2] > speeds[3] == 0.0 > speeds[4]
    assert decisions.next_velocity(dict, Pose(1.1, 0.0, 0.0), is_flying=True)[0][0] == 0.8  # the next decision


def test_the_runner_flies_to_its_waypoints_and_asks_only_when_a_decision_is_due():
    policy = Answers((0.5, 0.0), action=ActionSpec(mode="waypoint", decision_ticks=20))
    flight = FlatFlight(SETTINGS, policy)
    exploring(flight)
    asked, start = len(policy.seen), flight.vehicle.x
    for _ in range(19):
        assert flight.tick().status.decider == "policy"
    assert len(policy.seen) == asked
    assert flight.vehicle.x == pytest.approx(start + 1.0, abs=0.15)
    flight.tick()
    assert len(policy.seen) == asked + 1


def test_a_course_turns_the_drone_and_flies_it_ahead():
    policy = Answers((0.5, 0.5), action=ActionSpec(mode="forward"), observation=ObservationSpec(axes="heading"))
    flight = FlatFlight(SETTINGS, policy)
    output = exploring(flight)
    assert (output.setpoint.vx, output.setpoint.yaw_rate) == pytest.approx((0.4, 1.5))
    yaw = output.status.pose.yaw
    output = flight.tick()
    assert output.status.pose.yaw == pytest.approx(yaw + 0.15, abs=0.05)


def test_the_same_inputs_give_the_same_outputs_with_every_option_on():
    spec = ObservationSpec(view_cells=16, axes="heading", position=True, heading=True, peers=2, visits="team")

    def policy():
        return Answers((0.3, 0.4), (0.5, -0.2), (0.2, 0.6), (0.4, 0.0), action=STANDING, observation=spec)

    flight = FlatFlight(SETTINGS, policy())
    exploring(flight)
    for _ in range(30):
        flight.tick()
    again = make_runner(SETTINGS, policy())
    assert repr([again.tick(inputs) for inputs in flight.inputs]) == repr(flight.outputs)


def team_flight(spec: ObservationSpec, protocol: str = "one-hop"):
    """A flight with a radio, and the radio of a mate."""
    settings = SETTINGS.model_copy(update={"radio": SETTINGS.radio.model_copy(update={"protocol": protocol})})
    evidence = EvidenceMap(settings.drone_id)
    node = MeshNode(evidence, LD19, 4.0, settings.radio, Sealer(KEY, settings.drone_id, 1))
    policy = Answers((0.0, 0.0), observation=spec)
    flight = FlatFlight(settings, policy)
    flight.runner = make_runner(settings, policy, node, evidence)
    return flight, policy, MeshNode(EvidenceMap(2), LD19, 4.0, settings.radio, Sealer(KEY, 2, 1))


def say(mate: MeshNode, now: float, x: float, y: float, ladder: str = "policy") -> tuple[bytes, ...]:
    mate.set_status(messages.Status(id=2, stamp=now, pose=Pose(x, y, 0.0), ladder=ladder))
    return tuple(mate.poll(now))


@pytest.mark.parametrize(("protocol", "near"), [("one-hop", 0.2), ("off", 1.0)])
def test_a_mate_shows_at_its_last_reported_distance_for_two_seconds(protocol, near):
    flight, policy, mate = team_flight(ObservationSpec(view_cells=16, peers=2, peers_range_m=10.0), protocol)
    pose = flight.tick(datagrams=say(mate, 0.1, 1.5, 3.5)).status.pose
    away = math.hypot(pose.x - 1.5, pose.y - 3.5) / 10.0
    assert policy.seen[-1]["motion"][3:] == pytest.approx([away if near < 1.0 else 1.0, 1.0], abs=1e-6)
    for _ in range(20):
        flight.tick()
    assert policy.seen[-1]["motion"][3] == pytest.approx(near, abs=0.01)
    flight.tick()
    assert policy.seen[-1]["motion"][3:].tolist() == [1.0, 1.0]


def test_visits_begin_with_exploring_and_only_explorers_leave_them():
    flight, policy, mate = team_flight(ObservationSpec(view_cells=16, visits="team"))
    flight.fly_until(lambda output: output.status.phase == "explore", 10.0)
    visits = flight.runner.visits
    assert visits.own.sum() == 0  # neither the ground nor the climb counts
    for _ in range(10):
        flight.tick(datagrams=say(mate, flight.vehicle.now, 2.5, 1.5, ladder="climb"))
    assert (visits.own.sum(), visits.peers.sum()) == (10, 0)
    for _ in range(10):
        flight.tick(datagrams=say(mate, flight.vehicle.now, 2.5, 1.5))
    assert visits.own.sum() == 20
    column, row = (math.floor(c / 0.2) - o // 2 for c, o in zip((2.5, 1.5), visits.origin_cells, strict=True))
    assert 5 <= visits.peers[row, column] == visits.peers.sum() <= 10
    fine_own, _, coarse_own, coarse_peers = policy.seen[-1]["views"][4:]
    assert fine_own.max() == coarse_own.max() > 0.5
    (up, right), *others = (np.argwhere(coarse_peers > 0) - 7.5) * 0.4  # one block of 0.4 m, a metre to the east
    assert others == []
    assert (right, up) == pytest.approx((1.0, 0.0), abs=0.41)
