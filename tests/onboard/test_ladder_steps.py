"""The decision ladder steps down with a reason, comes back where it may, and never leaves a landing."""

from __future__ import annotations

import dataclasses
import math

import pytest

from imagine.core.frames import Pose
from imagine.onboard.ladder import STILL, Decider, Ladder, Order, Situation
from imagine.onboard.settings import LadderSettings

AHEAD = (0.5, 0.0, 0.0)
TOWARD = (0.0, 0.4, 0.0)
CALM = Situation(
    now=0.0,
    pose=Pose(0.0, 0.0, 0.0),
    policy=AHEAD,
    policy_failure="",
    frontier=TOWARD,
    frontier_m=5.0,
    new_cells=20,
    lost_s=0.0,
    lost_reason="",
    silent_s=0.0,
    battery=0.9,
    airborne_s=10.0,
    order=Order.RESUME,
)


def at(now: float, x: float = 0.0, **changes) -> Situation:
    return dataclasses.replace(CALM, now=now, pose=Pose(x, 0.0, 0.0), **changes)


def ladder(**changes) -> Ladder:
    return Ladder(LadderSettings(**changes), max_flight_s=300.0)


def run(subject: Ladder, ticks: range, **changes):
    """Decisions over ticks of 0.1 s with a drone that moves 0.5 m/s, unless `speed` says otherwise."""
    speed = changes.pop("speed", 0.5)
    return [subject.decide(at(0.1 * k, x=speed * 0.1 * k, **changes)) for k in ticks]


def test_the_policy_decides_while_it_gets_somewhere():
    decisions = run(ladder(), range(300))
    assert {d.decider for d in decisions} == {Decider.POLICY}
    assert decisions[-1].velocity == AHEAD


@pytest.mark.parametrize(
    ("changes", "decider", "words"),
    [
        ({"order": Order.LAND}, Decider.LAND, "pilot"),
        ({"order": Order.HOLD}, Decider.HOLD, "pilot"),
        ({"ending": True}, Decider.LAND, "asked to end"),
        ({"battery": 0.15}, Decider.LAND, "battery at 15%"),
        ({"lost_s": 0.6, "lost_reason": "too few returns"}, Decider.HOLD, "too few returns"),
        ({"lost_s": 3.1, "lost_reason": "no LiDAR scan"}, Decider.LAND, "no LiDAR scan"),
        ({"lost_s": math.inf}, Decider.LAND, "lost"),
        ({"silent_s": 0.6}, Decider.HOLD, "no telemetry"),
        ({"silent_s": 3.1}, Decider.LAND, "no telemetry"),
        ({"height_age_s": 3.1}, Decider.LAND, "no height"),
        ({"airborne_s": 301.0}, Decider.LAND, "300 s"),
        ({"frontier": None}, Decider.HOLD, "no frontier"),
        ({"exploring": False}, Decider.HOLD, "not yet exploring"),
        ({"has_scan": False}, Decider.HOLD, "scan"),
        ({"policy": None, "policy_failure": "the policy's output is not finite"}, Decider.FRONTIER, "not finite"),
    ],
)
def test_each_fault_has_its_rung_and_its_reason(changes, decider, words):
    decision = ladder().decide(at(0.0, **changes))
    assert decision.decider is decider
    assert words in decision.reason
    if decider in (Decider.HOLD, Decider.LAND):
        assert decision.velocity == STILL


def test_an_unknown_battery_does_not_land():
    assert ladder().decide(at(0.0, battery=None)).decider is Decider.POLICY


def test_faults_are_failsafes_and_orders_are_not():
    assert ladder().decide(at(0.0, battery=0.1)).failsafe
    assert not ladder().decide(at(0.0, order=Order.LAND)).failsafe


def test_holding_ends_with_its_cause():
    subject = ladder()
    assert subject.decide(at(0.0, lost_s=1.0)).decider is Decider.HOLD
    assert subject.decide(at(0.1, lost_s=0.0)).decider is Decider.POLICY


def test_a_landing_stands():
    subject = ladder()
    subject.decide(at(0.0, battery=0.1))
    decision = subject.decide(at(0.1, battery=0.9))
    assert decision.decider is Decider.LAND
    assert "battery" in decision.reason


def test_a_drone_that_stays_put_is_rescued_for_a_while_then_the_policy_has_it_again():
    decisions = run(ladder(stuck_still_s=4.0, rescue_s=5.0), range(100), speed=0.0)
    deciders = [d.decider for d in decisions]
    assert deciders[:40] == [Decider.POLICY] * 40
    assert deciders[40:90] == [Decider.FRONTIER] * 50
    assert deciders[90:] == [Decider.POLICY] * 10
    assert decisions[40].velocity == TOWARD
    assert "moved 0.00 m in 4 s" in decisions[40].reason


def test_a_rescue_ends_early_once_the_drone_has_travelled():
    subject = ladder(rescue_travel_m=1.5)
    run(subject, range(41), speed=0.0)
    deciders = [subject.decide(at(4.1 + 0.1 * k, x=0.08 * k)).decider for k in range(30)]
    assert deciders[:18] == [Decider.FRONTIER] * 18
    assert Decider.POLICY in deciders[18:20]


def test_rescues_that_follow_each_other_last_longer():
    decisions = run(ladder(), range(600), speed=0.0)
    lengths, count = [], 0
    for decision in decisions:
        if decision.decider is Decider.FRONTIER:
            count += 1
        elif count:
            lengths.append(count)
            count = 0
    assert lengths[:3] == [50, 100, 200]


def test_moving_in_circles_without_seeing_anything_new_is_stuck():
    subject = ladder(stuck_aimless_s=8.0)
    for k in range(80):
        circling = dataclasses.replace(
            CALM, now=0.1 * k, pose=Pose(math.cos(0.1 * k), math.sin(0.1 * k), 0.0), new_cells=0
        )
        assert subject.decide(circling).decider is Decider.POLICY
    decision = subject.decide(
        dataclasses.replace(CALM, now=8.0, pose=Pose(math.cos(8.0), math.sin(8.0), 0.0), new_cells=0)
    )
    assert decision.decider is Decider.FRONTIER
    assert "nothing new seen" in decision.reason


def test_flying_home_through_known_rooms_is_not_stuck_while_the_frontier_comes_nearer():
    subject = ladder()
    deciders = {
        subject.decide(at(0.1 * k, x=0.05 * k, new_cells=0, frontier_m=30.0 - 0.05 * k)).decider for k in range(300)
    }
    assert deciders == {Decider.POLICY}


def test_no_frontier_for_long_enough_means_explored():
    decisions = run(ladder(explored_s=5.0), range(60), frontier=None)
    assert {d.decider for d in decisions[:50]} == {Decider.HOLD}
    assert decisions[50].decider is Decider.LAND
    assert decisions[50].reason == "area explored"
    assert not decisions[50].failsafe


def test_a_teammates_map_that_opens_a_frontier_keeps_the_drone_flying():
    subject = ladder(explored_s=5.0)
    run(subject, range(40), frontier=None)
    assert subject.decide(at(4.0)).decider is Decider.POLICY
    assert {d.decider for d in run(subject, range(41, 90), frontier=None)} == {Decider.HOLD}


def test_blind_ticks_do_not_count_as_explored():
    subject = ladder(explored_s=5.0)
    decisions = run(subject, range(100), frontier=None, has_scan=False)
    assert {d.decider for d in decisions} == {Decider.HOLD}
