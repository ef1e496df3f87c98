"""`Runner.tick` flown through a small world: it explores, it is silent without scans, and it repeats bit for bit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flat_world import TWO_ROOMS, FlatFlight, make_runner, ray_ranges
from tiny_policy import make_contract

from imagine.core.contract import ActionSpec
from imagine.core.errors import WorkError
from imagine.core.evidence import EvidenceMap
from imagine.core.frames import wrap_angle
from imagine.core.lidar import LD19, Scan
from imagine.core.raster import CELL
from imagine.mesh_comm import messages
from imagine.mesh_comm.node import MeshNode
from imagine.mesh_comm.seal import Sealer
from imagine.onboard.records import FlightMode, Telemetry, TickInput, VehicleCommand
from imagine.onboard.settings import DroneSettings, LadderSettings, LaunchPose

LAUNCH = LaunchPose(x=1.5, y=1.5, yaw=0.4)
SETTINGS = DroneSettings(policy=None, launch=LAUNCH)
KEY = bytes(range(32))


class FixedPolicy:
    """Answers the same action for ever, or what a test makes of it."""

    def __init__(self, answer=(1.0, 0.0), error: str | None = None, **contract) -> None:
        self.contract = make_contract(**contract)
        self.answer = np.array(answer, np.float32)
        self.error = error
        self.seen = []

    def infer(self, observation, state):
        self.seen.append(observation)
        if self.error is not None:
            raise WorkError(self.error)
        return self.answer, state


def exploring(flight: FlatFlight):
    return flight.fly_until(lambda output: output.status.phase == "explore", longest_s=10.0)


def test_the_planner_alone_explores_both_rooms_and_lands():
    flight = FlatFlight(SETTINGS)
    done = flight.fly_until(lambda output: output.status.phase == "done")
    assert done.status.reason == "area explored"
    assert not flight.vehicle.state.armed
    assert max(output.status.pose.x for output in flight.outputs) > 4.5  # it went through the door
    belief = flight.runner.evidence.belief()
    column0, row0 = flight.runner.evidence.origin_cells
    free = belief[math.floor(0.5 / CELL) - row0 : math.floor(3.5 / CELL) - row0, -column0 : 80 - column0] < 0
    assert free.mean() > 0.9


def test_the_estimate_follows_the_truth():
    flight = FlatFlight(SETTINGS)
    errors = []
    exploring(flight)
    for _ in range(80):
        pose, truth = flight.tick().status.pose, flight.vehicle
        errors.append(math.hypot(pose.x - truth.x, pose.y - truth.y))
        assert abs(wrap_angle(pose.yaw - truth.yaw)) < 0.1
    assert math.sqrt(np.mean(np.square(errors))) < 0.05


def test_the_same_inputs_give_the_same_outputs_bit_for_bit():
    flight = FlatFlight(SETTINGS, FixedPolicy((0.3, 0.2)))
    exploring(flight)
    for _ in range(60):
        flight.tick()
    again = make_runner(SETTINGS, FixedPolicy((0.3, 0.2)))
    outputs = [again.tick(inputs) for inputs in flight.inputs]
    assert repr(outputs) == repr(flight.outputs)
    assert outputs == flight.outputs
    assert again.evidence.belief().tobytes() == flight.runner.evidence.belief().tobytes()


def test_a_tick_leaves_its_inputs_alone():
    flight = FlatFlight(SETTINGS)
    before = [scan_bytes(flight) for _ in range(30)]
    assert [inputs.scan.ranges.tobytes() for inputs in flight.inputs] == before


def scan_bytes(flight: FlatFlight) -> bytes:
    kept = {}
    tick = flight.runner.tick

    def watch(inputs):
        kept["bytes"] = inputs.scan.ranges.tobytes()
        return tick(inputs)

    flight.runner.tick = watch
    flight.tick()
    flight.runner.tick = tick
    return kept["bytes"]


def test_setpoints_stream_from_the_first_scan_and_are_zero_on_the_ground():
    flight = FlatFlight(SETTINGS)
    for _ in range(5):
        setpoint = flight.tick().setpoint
        assert (setpoint.vx, setpoint.vy, setpoint.vz, setpoint.yaw_rate) == (0.0, 0.0, 0.0, 0.0)


def test_without_a_fresh_scan_there_is_no_setpoint_and_no_odometry():
    flight = FlatFlight(SETTINGS)
    exploring(flight)
    silent = flight.tick(has_scan=False)
    assert silent.setpoint is None
    assert silent.odometry is None
    stale = flight.runner.tick(replace(flight.inputs[-1], scan=flight.inputs[-2].scan))
    assert stale.setpoint is None
    assert flight.tick().setpoint is not None


def test_a_lidar_that_stays_away_is_told_and_then_the_drone_is_asked_to_land():
    flight = FlatFlight(SETTINGS)
    exploring(flight)
    reasons = []
    for _ in range(40):
        output = flight.tick(has_scan=False)
        reasons.append(output.status.reason)
        if VehicleCommand.LAND in output.commands:
            break
    assert any("no LiDAR scan" in reason for reason in reasons)
    # its own failsafe was faster: silence of a second already made it land
    assert output.status.phase in ("land", "released")
    assert flight.vehicle.state.mode is FlightMode.LAND


def test_the_policy_flies_along_the_maps_axes():
    flight = FlatFlight(SETTINGS, FixedPolicy((0.0, 0.5)))
    exploring(flight)
    output = flight.fly_until(lambda output: output.status.decider == "policy", longest_s=1.0)
    yaw = output.status.pose.yaw
    assert output.setpoint.vx == pytest.approx(0.4 * math.sin(yaw), abs=1e-6)
    assert output.setpoint.vy == pytest.approx(0.4 * math.cos(yaw), abs=1e-6)


def test_the_policy_sees_what_its_contract_promises():
    policy = FixedPolicy()
    flight = FlatFlight(SETTINGS, policy)
    flight.tick()
    shapes = {name: array.shape for name, array in policy.seen[-1].items()}
    assert shapes == policy.contract.observation.shapes
    assert all(array.dtype == np.float32 and np.isfinite(array).all() for array in policy.seen[-1].values())


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (FixedPolicy((math.nan, 0.0)), "not finite"),
        (FixedPolicy((1.0, 0.0, 0.0)), "shape (3,), expected (2,)"),
        (FixedPolicy(error="policy inference failed: out of memory"), "out of memory"),
        (None, "no policy"),
    ],
)
def test_a_policy_that_fails_hands_over_to_the_planner_in_words(policy, words):
    flight = FlatFlight(SETTINGS, policy)
    exploring(flight)
    output = flight.fly_until(lambda output: output.status.decider == "frontier", longest_s=1.0)
    assert words in output.status.reason
    assert math.hypot(output.setpoint.vx, output.setpoint.vy) > 0.1


def test_a_policy_that_flies_at_a_wall_is_stopped_before_it_and_then_rescued():
    flight = FlatFlight(SETTINGS, FixedPolicy((-1.0, 0.0)))
    exploring(flight)
    nearest = []
    rescued = None
    for _ in range(120):
        output = flight.tick()
        nearest.append(ray_ranges(TWO_ROOMS, flight.vehicle.x, flight.vehicle.y, 0.0).min())
        if output.status.decider == "frontier":
            rescued = output
            break
    assert min(nearest) > SETTINGS.limits.radius_m
    assert rescued is not None
    assert "policy stuck" in rescued.status.reason


def test_no_setpoint_is_faster_than_the_vehicle():
    settings = SETTINGS.model_copy(update={"limits": SETTINGS.limits.model_copy(update={"speed_mps": 0.3})})
    policy = FixedPolicy((1.0, 0.2, 1.0), action=ActionSpec(mode="body", speed_mps=0.8))
    flight = FlatFlight(settings, policy)
    exploring(flight)
    for _ in range(20):
        setpoint = flight.tick().setpoint
        assert math.hypot(setpoint.vx, setpoint.vy) <= 0.3 + 1e-9
        assert abs(setpoint.yaw_rate) <= settings.limits.yaw_rate_rps


def test_a_flat_battery_lands_and_says_so():
    flight = FlatFlight(SETTINGS, FixedPolicy())
    exploring(flight)
    flight.vehicle.state = replace(flight.vehicle.state, battery=0.1)
    output = flight.tick()
    assert VehicleCommand.LAND in output.commands
    assert [event.text for event in output.events if event.kind == "failsafe"] == ["land: battery at 10%"]
    assert flight.fly_until(lambda output: output.status.phase == "done", 10.0).status.reason == "battery at 10%"


def test_asked_to_end_it_lands():
    flight = FlatFlight(SETTINGS, FixedPolicy())
    exploring(flight)
    assert VehicleCommand.LAND in flight.tick(ending=True).commands


def test_an_autopilot_that_takes_over_is_left_alone():
    flight = FlatFlight(SETTINGS, FixedPolicy())
    exploring(flight)
    flight.vehicle.state = replace(flight.vehicle.state, mode=FlightMode.POSITION)
    output = flight.tick()
    assert output.setpoint is None
    assert "left OFFBOARD for POSITION" in output.status.reason
    assert flight.tick().setpoint is None


def test_a_longest_flight_is_kept():
    flight = FlatFlight(SETTINGS.model_copy(update={"max_flight_s": 3.0}), FixedPolicy())
    landing = flight.fly_until(lambda output: output.status.phase == "land", 20.0)
    assert "3 s" in landing.status.reason


def mesh_pair(settings: DroneSettings):
    """A runner with a mesh node, and a ground station's node."""
    evidence = EvidenceMap(settings.drone_id)
    cap = settings.map.range_cap_m
    node = MeshNode(evidence, LD19, cap, settings.radio, Sealer(KEY, settings.drone_id, 1))
    ground = MeshNode(EvidenceMap(0), LD19, cap, settings.radio, Sealer(KEY, 0, 1))
    return make_runner(settings, FixedPolicy(), node, evidence), ground


def introduce(flight, ground):
    """Let the ground hear the drone: it has to know a drone's start to order it anything."""
    for _ in range(10):
        for datagram in flight.tick().datagrams:
            ground.receive(datagram, flight.vehicle.now)
    assert ground.peers(flight.vehicle.now)[SETTINGS.drone_id].is_live


def test_the_pilot_holds_resumes_and_lands_it_by_mesh():
    flight = FlatFlight(SETTINGS, FixedPolicy((0.2, 0.0)))
    flight.runner, ground = mesh_pair(SETTINGS)
    exploring(flight)
    introduce(flight, ground)
    for action, decider in (("hold", "hold"), ("resume", "policy"), ("land", "land")):
        ground.send_command(action, 0, flight.vehicle.now)
        output = flight.tick(datagrams=tuple(ground.poll(flight.vehicle.now)))
        assert output.status.decider == decider
    assert VehicleCommand.LAND in output.commands


@pytest.mark.parametrize("later", ["resume", "hold"])
def test_no_later_order_takes_a_landing_back(later):
    flight = FlatFlight(SETTINGS, FixedPolicy((0.2, 0.0)))
    flight.runner, ground = mesh_pair(SETTINGS)
    exploring(flight)
    introduce(flight, ground)
    datagrams = []
    for action in ("land", later):  # both arrive before the next tick
        ground.send_command(action, 0, flight.vehicle.now)
        datagrams += ground.poll(flight.vehicle.now)
    assert VehicleCommand.LAND in flight.tick(datagrams=tuple(datagrams)).commands
    done = flight.fly_until(lambda output: output.status.phase == "done", longest_s=10.0)
    assert done.status.reason == "the pilot ordered landing"


def test_a_rangefinder_that_falls_silent_stops_the_climb_and_then_lands_as_a_failsafe():
    flight = FlatFlight(SETTINGS, FixedPolicy((0.2, 0.0)))
    exploring(flight)
    flight.vehicle.height = 0.6
    told = flight.vehicle.telemetry
    assert flight.tick().setpoint.vz > 0.0
    silent_at = flight.vehicle.now

    def without_rangefinder():
        return replace(told(), ranged=False, height_age_s=flight.vehicle.now - silent_at)

    flight.vehicle.telemetry = without_rangefinder
    outputs = [flight.tick() for _ in range(32)]
    assert all(output.setpoint.vz == 0.0 for output in outputs[5:])
    assert VehicleCommand.LAND in outputs[-1].commands + outputs[-2].commands
    assert any(e.kind == "failsafe" and "no height" in e.text for output in outputs for e in output.events)


def test_a_height_that_is_the_autopilots_own_goes_back_to_it_with_a_wide_variance():
    flight = FlatFlight(SETTINGS)
    ranged = flight.tick().odometry
    assert ranged.height_variance == ranged.position_variance
    told = flight.vehicle.telemetry
    flight.vehicle.telemetry = lambda: replace(told(), ranged=False)
    assert flight.tick().odometry.height_variance >= 100.0


def test_its_state_and_reason_reach_the_ground():
    runner, ground = mesh_pair(SETTINGS)
    flight = FlatFlight(SETTINGS)
    flight.runner = runner
    for datagram in flight.tick().datagrams:
        ground.receive(datagram, flight.vehicle.now)
    status = ground.peers(flight.vehicle.now)[SETTINGS.drone_id].status
    assert status.ladder == "prepare"
    assert "waiting for" in status.reason


def test_a_teammate_in_sight_is_not_mapped():
    seen = ray_ranges(TWO_ROOMS, 1.5, 1.5, 0.0)
    seen[0:5] = seen[-4:] = 1.0  # someone hovers a metre ahead, at (2.5, 1.5)
    cells = {}
    for known in (False, True):
        runner, _ = mesh_pair(SETTINGS.model_copy(update={"launch": LaunchPose(x=1.5, y=1.5)}))
        mate = MeshNode(EvidenceMap(2), LD19, 4.0, SETTINGS.radio, Sealer(KEY, 2, 1))
        for tick in range(4):
            now = 0.1 * tick
            mate.set_status(messages.Status(id=2, stamp=now, pose=runner.settings.launch.pose._replace(x=2.5)))
            datagrams = tuple(mate.poll(now)) if known else ()
            runner.tick(TickInput(now, Scan(now, seen), Telemetry(now), datagrams))
        column0, row0 = runner.evidence.origin_cells
        cells[known] = int(runner.evidence.belief()[15 - row0, 25 - column0])
    assert cells[False] > 0
    assert cells[True] <= 0


def test_noise_from_the_radio_changes_nothing_but_a_counter():
    outputs = []
    for datagrams in ((), (b"", b"noise", bytes(1200))):
        flight = FlatFlight(SETTINGS)
        flight.runner, _ = mesh_pair(SETTINGS)
        exploring(flight)
        flight.vehicle.advance(0.1)
        before = sum(flight.runner.mesh.stats.values())
        outputs.append(
            flight.runner.tick(TickInput(flight.vehicle.now, flight.scan(), flight.vehicle.telemetry(), datagrams))
        )
        assert sum(flight.runner.mesh.stats.values()) == before + len(datagrams)
    quiet, noisy = outputs
    assert noisy.setpoint == quiet.setpoint
    assert abs(noisy.setpoint.vx) + abs(noisy.setpoint.vy) > 0.1  # it flies


def test_a_yaw_reset_of_the_autopilot_does_not_lose_track():
    flight = FlatFlight(SETTINGS)
    exploring(flight)
    turned = 0.0
    for tick in range(20):
        if tick == 10:
            turned = 2.0
        flight.vehicle.advance(0.1)
        telemetry = flight.vehicle.telemetry()
        told = replace(telemetry, yaw=wrap_angle(telemetry.yaw + turned))
        output = flight.runner.tick(TickInput(flight.vehicle.now, flight.scan(), told))
        assert output.status.tracked
    assert abs(wrap_angle(output.status.pose.yaw - flight.vehicle.yaw)) < 0.05


def test_rescue_settings_reach_the_ladder():
    settings = SETTINGS.model_copy(update={"ladder": LadderSettings(stuck_still_s=1.0)})
    flight = FlatFlight(settings, FixedPolicy((0.0, 0.0)))
    exploring(flight)
    rescued = flight.fly_until(lambda output: output.status.decider == "frontier", longest_s=2.0)
    assert "in 1 s" in rescued.status.reason
