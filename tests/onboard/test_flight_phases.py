"""A flight's phases advance by what telemetry shows, and every wait ends in words."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import pytest

from imagine.onboard.flight import Flight
from imagine.onboard.phases import Phase
from imagine.onboard.records import Ack, FlightMode, Telemetry, VehicleCommand
from imagine.onboard.settings import FlightSettings

GROUND = Telemetry(0.0, mode=FlightMode.HOLD, position_ok=True)


class Bench:
    """A flight fed with telemetry as the test wants it, 10 Hz."""

    def __init__(self, **settings) -> None:
        self.flight = Flight(FlightSettings(**settings))
        self.telemetry: Telemetry | None = GROUND
        self.tick = 0
        self.commands: list[tuple[float, VehicleCommand]] = []
        self.events = []

    def see(self, **changes) -> None:
        self.telemetry = dataclasses.replace(self.telemetry or GROUND, **changes)

    def step(self, ticks: int = 1, tracked: bool = True, fresh: bool = True, **extra):
        for _ in range(ticks):
            now = round(0.1 * self.tick, 6)
            self.tick += 1
            told = self.telemetry
            if told is not None and fresh:
                told = dataclasses.replace(told, stamp=now)
            step = self.flight.step(now, told, tracked, **extra)
            self.commands += [(now, command) for command in step.commands]
            self.events += step.events
        return step

    def fly_to(self, phase: Phase) -> None:
        """Take the shortest way to a phase."""
        self.step(11)
        if phase is Phase.OFFBOARD:
            return
        self.see(mode=FlightMode.OFFBOARD)
        self.step()
        if phase is Phase.ARM:
            return
        self.see(armed=True)
        self.step()
        if phase is Phase.CLIMB:
            return
        self.see(height_m=0.95, landed=False)
        self.step()
        if phase is Phase.EXPLORE:
            return
        self.step(land_reason="area explored")
        self.see(mode=FlightMode.LAND)


@pytest.mark.parametrize("phase", [Phase.OFFBOARD, Phase.ARM, Phase.CLIMB, Phase.EXPLORE, Phase.LAND])
def test_the_phases_follow_in_order(phase):
    bench = Bench()
    bench.fly_to(phase)
    assert bench.flight.phase is phase


def test_commands_come_in_px4_order_and_only_once_each_when_obeyed():
    bench = Bench()
    bench.fly_to(Phase.LAND)
    assert [command for _, command in bench.commands] == [
        VehicleCommand.OFFBOARD,
        VehicleCommand.ARM,
        VehicleCommand.LAND,
    ]


def test_offboard_is_requested_only_after_a_second_of_setpoints():
    bench = Bench()
    bench.fly_to(Phase.OFFBOARD)
    assert bench.commands[0] == (1.0, VehicleCommand.OFFBOARD)


@pytest.mark.parametrize(
    ("change", "step", "words"),
    [
        ({}, {"tracked": False}, "tracked LiDAR scans"),
        ({"position_ok": False}, {}, "position estimate"),
        ({"armed": True}, {}, "a disarmed vehicle"),
    ],
)
def test_what_is_missing_before_takeoff_is_named(change, step, words):
    bench = Bench(ready_deadline_s=5.0)
    bench.see(**change)
    waiting = bench.step(30, **step)
    assert waiting.phase is Phase.PREPARE
    assert words in waiting.reason
    assert not bench.commands
    failed = bench.step(30, **step)
    assert failed.phase is Phase.FAILED
    assert words in failed.reason
    assert not failed.streams


def test_a_vehicle_never_heard_is_a_failure():
    bench = Bench(ready_deadline_s=2.0)
    bench.telemetry = None
    assert bench.step(30).reason == "the vehicle was never heard"


def test_a_request_is_repeated_until_its_deadline_and_the_answer_is_told():
    bench = Bench(offboard_deadline_s=4.0, retry_s=1.0)
    bench.fly_to(Phase.OFFBOARD)
    bench.see(acks=(Ack(VehicleCommand.OFFBOARD, False, "TEMPORARILY_REJECTED"),))
    failed = bench.step(50)
    assert failed.phase is Phase.FAILED
    assert "HOLD" in failed.reason
    assert "TEMPORARILY_REJECTED" in failed.reason
    assert [command for _, command in bench.commands] == [VehicleCommand.OFFBOARD] * 5


def test_an_acknowledgement_alone_changes_nothing():
    bench = Bench()
    bench.fly_to(Phase.OFFBOARD)
    bench.see(acks=(Ack(VehicleCommand.OFFBOARD, True, "ACCEPTED"),))
    assert bench.step(5).phase is Phase.OFFBOARD


def test_a_mode_that_falls_back_before_arming_is_asked_for_again():
    bench = Bench()
    bench.fly_to(Phase.ARM)
    bench.see(mode=FlightMode.HOLD)
    bench.step(3)
    assert bench.commands[-1][1] is VehicleCommand.OFFBOARD
    assert bench.flight.phase is Phase.ARM


def test_arming_that_is_denied_ends_in_words():
    bench = Bench(arm_deadline_s=3.0)
    bench.fly_to(Phase.ARM)
    bench.see(acks=(Ack(VehicleCommand.ARM, False, "FAILED"),))
    failed = bench.step(60)
    assert failed.phase is Phase.FAILED
    assert failed.reason == "the autopilot does not arm: arm was answered FAILED"


def test_it_climbs_up_and_then_holds_its_height():
    bench = Bench(height_m=1.0, climb_mps=0.6)
    bench.fly_to(Phase.CLIMB)
    assert bench.step().vz == pytest.approx(0.6)
    bench.see(height_m=0.95)
    bench.step()
    assert bench.flight.phase is Phase.EXPLORE
    bench.see(height_m=1.2)
    assert bench.step().vz == pytest.approx(-0.2)


def test_a_climb_that_gets_nowhere_lands():
    bench = Bench(climb_deadline_s=3.0)
    bench.fly_to(Phase.CLIMB)
    landing = bench.step(40)
    assert landing.phase is Phase.LAND
    assert "was not reached" in landing.reason
    assert bench.commands[-1][1] is VehicleCommand.LAND


@pytest.mark.parametrize("phase", [Phase.CLIMB, Phase.EXPLORE])
@pytest.mark.parametrize(
    ("change", "words"),
    [({"mode": FlightMode.LAND}, "left OFFBOARD for LAND"), ({"armed": False}, "disarmed in flight")],
)
def test_a_vehicle_taken_away_is_let_go_for_good(phase, change, words):
    bench = Bench()
    bench.fly_to(phase)
    bench.see(**change)
    released = bench.step()
    assert released.phase is Phase.RELEASED
    assert words in released.reason
    assert not released.streams
    assert any(event.kind == "failsafe" for event in bench.events)
    bench.see(mode=FlightMode.OFFBOARD, armed=True)
    again = bench.step(30)
    assert again.phase is Phase.RELEASED
    assert not again.streams


def test_landing_ends_disarmed():
    bench = Bench()
    bench.fly_to(Phase.LAND)
    assert bench.step(5).phase is Phase.LAND
    bench.see(armed=False, landed=True, mode=FlightMode.HOLD)
    done = bench.step()
    assert done.phase is Phase.DONE
    assert done.reason == "area explored"


def test_a_vehicle_that_stays_armed_on_the_ground_is_disarmed():
    bench = Bench()
    bench.fly_to(Phase.LAND)
    bench.see(landed=True, height_m=0.0)
    bench.step()
    assert bench.commands[-1][1] is VehicleCommand.DISARM


def test_a_pilot_who_takes_over_a_landing_keeps_the_vehicle():
    bench = Bench()
    bench.fly_to(Phase.LAND)
    bench.step()
    bench.see(mode=FlightMode.POSITION)
    assert bench.step().phase is Phase.RELEASED


@pytest.mark.parametrize("phase", [Phase.PREPARE, Phase.OFFBOARD])
def test_asked_to_land_on_the_ground_it_stays_there(phase):
    bench = Bench()
    if phase is not Phase.PREPARE:
        bench.fly_to(phase)
    done = bench.step(land_reason="battery at 5%")
    assert done.phase is Phase.DONE
    assert done.reason == "battery at 5%"


def test_an_arming_once_asked_for_is_taken_back_until_the_vehicle_has_stayed_disarmed():
    bench = Bench(retry_s=1.0)
    bench.fly_to(Phase.ARM)
    bench.commands.clear()
    order = {"land_reason": "battery at 5%"}
    assert bench.step(10, **order).phase is Phase.DISARM
    bench.see(armed=True)  # the autopilot obeys the arming late
    assert bench.step(15, **order).phase is Phase.DISARM
    bench.see(armed=False)
    assert bench.step(10, fresh=False, **order).phase is Phase.DISARM  # what is old shows nothing
    assert bench.step(20, **order).phase is Phase.DISARM
    done = bench.step(**order)
    assert (done.phase, done.reason) == (Phase.DONE, "battery at 5%")
    assert {command for _, command in bench.commands} == {VehicleCommand.DISARM}
    times = [at for at, _ in bench.commands]
    assert [round(b - a, 6) for a, b in pairwise(times)] == [1.0] * (len(times) - 1)
    assert len(times) == 6


def test_an_arming_that_comes_after_its_deadline_is_taken_back():
    bench = Bench(arm_deadline_s=3.0)
    bench.fly_to(Phase.ARM)
    assert bench.step(32).phase is Phase.DISARM
    bench.see(armed=True)
    late = bench.step(10)
    assert (late.phase, late.vz, late.streams) == (Phase.DISARM, 0.0, True)
    assert bench.commands[-1][1] is VehicleCommand.DISARM
    bench.see(armed=False)
    assert bench.step(25).phase is Phase.FAILED


def test_a_vehicle_that_will_not_disarm_is_left_to_the_autopilot_in_words():
    bench = Bench(land_deadline_s=5.0)
    bench.fly_to(Phase.ARM)
    bench.see(armed=True)
    released = bench.step(60, land_reason="battery at 5%")
    assert released.phase is Phase.RELEASED
    assert "not seen disarmed for 5 s" in released.reason


@pytest.mark.parametrize("phase", [Phase.OFFBOARD, Phase.ARM])
def test_a_hold_before_takeoff_goes_back_to_the_ground(phase):
    bench = Bench()
    bench.fly_to(phase)
    bench.see(mode=FlightMode.OFFBOARD)
    held = bench.step(25, may_start=False)
    assert (held.phase, held.reason) == (Phase.PREPARE, "held on the ground by the pilot")
    asked = [command for _, command in bench.commands]
    assert (VehicleCommand.DISARM in asked) == (VehicleCommand.ARM in asked) == (phase is Phase.ARM)
    bench.step(2)
    assert bench.commands[-1][1] is VehicleCommand.ARM


def test_it_does_not_climb_by_old_telemetry_or_an_old_height():
    bench = Bench()
    bench.fly_to(Phase.CLIMB)
    assert bench.step().vz > 0.0
    bench.see(height_age_s=0.6)
    assert bench.step().vz == 0.0
    bench.see(height_age_s=0.0)
    assert bench.step().vz > 0.0
    bench.telemetry = dataclasses.replace(bench.telemetry, stamp=0.1 * bench.tick)
    assert bench.step(5, fresh=False).vz > 0.0
    assert bench.step(2, fresh=False).vz == 0.0


def test_a_hold_keeps_it_on_the_ground_for_as_long_as_it_stands():
    bench = Bench(ready_deadline_s=3.0)
    held = bench.step(100, may_start=False)
    assert held.phase is Phase.PREPARE
    assert "held" in held.reason
    assert bench.step(2).phase is Phase.OFFBOARD


def test_old_telemetry_does_not_count_as_ready():
    bench = Bench(ready_deadline_s=5.0)
    bench.step(1)
    waiting = bench.step(30, fresh=False)
    assert "fresh telemetry" in waiting.reason
