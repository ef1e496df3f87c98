"""Two drones that were given one id: in the air both land, on the ground neither starts; recordings change nothing."""

from __future__ import annotations

import pytest
from flat_world import FlatFlight, make_runner

from imagine.core.errors import WorkError
from imagine.core.evidence import EvidenceMap
from imagine.core.lidar import LD19
from imagine.mesh_comm.node import MeshNode
from imagine.mesh_comm.seal import Sealer
from imagine.onboard.process import _raise_failure
from imagine.onboard.records import TickOutput, VehicleCommand
from imagine.onboard.settings import DroneSettings, LaunchPose

SETTINGS = DroneSettings(drone_id=3, policy=None, launch=LaunchPose(x=1.5, y=1.5))
KEY = bytes(range(32))


def drone(boot: int) -> FlatFlight:
    flight = FlatFlight(SETTINGS)
    evidence = EvidenceMap(3)
    node = MeshNode(evidence, LD19, SETTINGS.map.range_cap_m, SETTINGS.radio, Sealer(KEY, 3, boot))
    flight.runner = make_runner(SETTINGS, None, node, evidence)
    return flight


def together(pair: tuple[FlatFlight, FlatFlight], ticks: int) -> list[list[TickOutput]]:
    """Fly both for so many ticks, each hearing what the other said the tick before."""
    flown: list[list[TickOutput]] = [[], []]
    said: list[tuple[bytes, ...]] = [(), ()]
    for _ in range(ticks):
        outputs = [flight.tick(datagrams=said[1 - index]) for index, flight in enumerate(pair)]
        said = [output.datagrams for output in outputs]
        for index, output in enumerate(outputs):
            flown[index].append(output)
    return flown


def exploring(flight: FlatFlight) -> TickOutput:
    return flight.fly_until(lambda output: output.status.phase == "explore", longest_s=10.0)


def test_in_the_air_both_land_and_say_why() -> None:
    pair = drone(10), drone(20)
    for flight in pair:
        exploring(flight)
    for flight, outputs in zip(pair, together(pair, 60), strict=True):
        assert any(VehicleCommand.LAND in output.commands for output in outputs)
        told = [event.text for output in outputs for event in output.events if event.kind == "failsafe"]
        assert told
        assert all("another node is on the air as drone 3" in text for text in told)
        assert not flight.vehicle.state.armed
        with pytest.raises(WorkError, match=r"drone 3 .*another node .* set another drone_id"):
            _raise_failure(flight.runner, None)


def test_on_the_ground_neither_starts() -> None:
    pair = drone(10), drone(20)
    for outputs in together(pair, 40):
        assert not any(VehicleCommand.ARM in output.commands for output in outputs)
        assert outputs[-1].status.phase == "done"
        assert "another node is on the air as drone 3" in outputs[-1].status.reason


def test_recordings_of_its_own_flights_do_not_stop_a_drone() -> None:
    before = drone(9)
    exploring(before)
    together((before, drone(8)), 60)  # recordings with claims among them
    recorded = [datagram for output in before.outputs for datagram in output.datagrams]
    flight = drone(10)
    exploring(flight)
    recorded += [datagram for output in flight.outputs for datagram in output.datagrams]
    assert len(recorded) > 20
    for start in range(0, len(recorded), 10):
        output = flight.tick(datagrams=tuple(recorded[start : start + 10]))
        assert output.status.phase == "explore"
    _raise_failure(flight.runner, None)
