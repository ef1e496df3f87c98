"""The phases of a flight, from the first telemetry to disarmed on the ground: a pure machine, driven by ticks.

Asking is not having: every phase ends by what telemetry shows, never by an acknowledgement, and every wait has a
deadline whose passing is told in plain words.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from imagine.onboard.phases import TAKEOFFS, Phase
from imagine.onboard.records import Event, FlightMode, Telemetry, VehicleCommand
from imagine.onboard.settings import FlightSettings

_TELEMETRY_FRESH_S = 0.5
_HEIGHT_REACHED_M = 0.1
_HELD = "held on the ground by the pilot"
_DISARMED_S = 2.0  # an autopilot may obey the arming late: disarmed is what has stayed disarmed for so long
_TRACKED_TICKS = 5
"""So many scans tracked in a row before takeoff, half a second: the map hangs on the first ones."""


@dataclass(frozen=True)
class FlightStep:
    """What a tick of the machine wants: commands to send, a climb speed (m/s, up), whether setpoints may be sent."""

    phase: Phase
    reason: str
    commands: tuple[VehicleCommand, ...]
    vz: float
    streams: bool
    events: tuple[Event, ...]


class Flight:
    """The phase machine of one flight."""

    def __init__(self, settings: FlightSettings, autopilot: str = "px4") -> None:
        """Start on the ground; `autopilot` is a key of TAKEOFFS."""
        self.settings = settings
        self.takeoff = TAKEOFFS[autopilot]
        self.phase = Phase.PREPARE
        self.reason = "waiting for the vehicle"
        self._since: float | None = None
        self._stream_since: float | None = None
        self._asked_at: dict[VehicleCommand, float] = {}
        self._answer = ""
        self._tracked_ticks = 0
        self._events: list[Event] = []
        self._airborne_since: float | None = None
        self._disarmed_since: float | None = None
        self._after_disarm = Phase.DONE

    def airborne_s(self, now: float) -> float:
        """Return for how long the vehicle has been flying, 0 before takeoff."""
        return 0.0 if self._airborne_since is None else now - self._airborne_since

    def step(
        self,
        now: float,
        telemetry: Telemetry | None,
        tracked: bool,
        land_reason: str | None = None,
        may_start: bool = True,
    ) -> FlightStep:
        """Advance by one tick.

        `tracked`: a fresh scan was tracked. `land_reason`: the ladder, or the pilot, wants the vehicle down.
        `may_start` false keeps it on the ground, and takes back a start that has not left it.
        """
        self._events = []
        self._since = now if self._since is None else self._since
        self._tracked_ticks = self._tracked_ticks + 1 if tracked else 0
        fresh = telemetry is not None and now - telemetry.stamp <= _TELEMETRY_FRESH_S
        commands: tuple[VehicleCommand, ...] = ()
        if telemetry is not None:
            self._listen(now, telemetry)
            step: dict[Phase, Callable[[], tuple[VehicleCommand, ...]]] = {
                Phase.PREPARE: lambda: self._prepare(now, telemetry, fresh, land_reason, may_start),
                Phase.OFFBOARD: lambda: self._request_offboard(now, telemetry, land_reason, may_start),
                Phase.ARM: lambda: self._arm(now, telemetry, land_reason, may_start),
                Phase.DISARM: lambda: self._disarm(now, telemetry, fresh, land_reason),
                Phase.CLIMB: lambda: self._climb(now, telemetry, land_reason),
                Phase.EXPLORE: lambda: self._explore(now, telemetry, land_reason),
                Phase.LAND: lambda: self._land(now, telemetry),
            }
            if self.phase in step:
                commands = step[self.phase]()
        elif now - self._since > self.settings.ready_deadline_s:
            self._enter(Phase.FAILED, now, "the vehicle was never heard")
        streams = self.phase not in (Phase.RELEASED, Phase.FAILED)
        if streams and tracked and self._stream_since is None:
            self._stream_since = now
        vz = self._climb_speed(telemetry) if telemetry is not None and fresh else 0.0
        return FlightStep(self.phase, self.reason, commands, vz, streams, tuple(self._events))

    def _listen(self, now: float, telemetry: Telemetry) -> None:
        for ack in telemetry.acks:
            if not ack.accepted:
                self._answer = f": {ack.command.value} was answered {ack.result}"
                self._events.append(Event(now, "command", f"{ack.command.value} was answered {ack.result}"))
        for text in telemetry.texts:
            self._events.append(Event(now, "autopilot", text))

    def _prepare(
        self, now: float, telemetry: Telemetry, fresh: bool, land_reason: str | None, may_start: bool
    ) -> tuple[VehicleCommand, ...]:
        if land_reason is not None:
            return self._stay_down(now, telemetry, land_reason)
        streamed = 0.0 if self._stream_since is None else now - self._stream_since
        missing = [
            name
            for name, there in (
                ("fresh telemetry", fresh),
                ("a disarmed vehicle", not telemetry.armed),
                ("tracked LiDAR scans", self._tracked_ticks >= _TRACKED_TICKS),
                ("the autopilot's position estimate", telemetry.position_ok),
                (
                    "a second of setpoints",
                    not self.takeoff.needs_stream or streamed >= self.settings.stream_s - 1e-6,
                ),
            )
            if not there
        ]
        if not may_start:
            self.reason = _HELD
            self._since = now
        elif missing:
            self.reason = "waiting for " + ", ".join(missing)
            if self._overdue(now, self.settings.ready_deadline_s):
                self._enter(Phase.FAILED, now, f"not ready to fly: still {self.reason}")
        else:
            self._advance(now, "requesting OFFBOARD")
            return self._ask(VehicleCommand.OFFBOARD, now)
        return ()

    def _request_offboard(
        self, now: float, telemetry: Telemetry, land_reason: str | None, may_start: bool
    ) -> tuple[VehicleCommand, ...]:
        if land_reason is not None:
            return self._stay_down(now, telemetry, land_reason)
        if not may_start:
            self._enter(Phase.PREPARE, now, _HELD)
            return ()
        if telemetry.mode is FlightMode.OFFBOARD:
            self._advance(now, "arming")
            return self._ask(VehicleCommand.ARM, now)
        if self._overdue(now, self.settings.offboard_deadline_s):
            self._enter(Phase.FAILED, now, f"the autopilot stays in {telemetry.mode.value}{self._answer}")
            return ()
        return self._ask(VehicleCommand.OFFBOARD, now)

    def _arm(
        self, now: float, telemetry: Telemetry, land_reason: str | None, may_start: bool
    ) -> tuple[VehicleCommand, ...]:
        if land_reason is not None:
            return self._take_back(now, land_reason, Phase.DONE)
        if not may_start:
            return self._take_back(now, _HELD, Phase.PREPARE)
        if telemetry.armed and telemetry.mode is FlightMode.OFFBOARD:
            self._airborne_since = now
            self._advance(now, f"climbing to {self.settings.height_m:.1f} m")
            return ()
        if self._overdue(now, self.settings.arm_deadline_s):
            return self._take_back(now, f"the autopilot does not arm{self._answer}", Phase.FAILED)
        if telemetry.mode is not FlightMode.OFFBOARD:
            return self._ask(VehicleCommand.OFFBOARD, now)
        return self._ask(VehicleCommand.ARM, now)

    def _take_back(self, now: float, reason: str, then: Phase) -> tuple[VehicleCommand, ...]:
        """Disarm: arming was asked for, and may yet be obeyed."""
        self._after_disarm, self._disarmed_since = then, None
        self._enter(Phase.DISARM, now, reason)
        return self._ask(VehicleCommand.DISARM, now)

    def _disarm(
        self, now: float, telemetry: Telemetry, fresh: bool, land_reason: str | None
    ) -> tuple[VehicleCommand, ...]:
        if land_reason is not None and self._after_disarm is Phase.PREPARE:  # a hold that becomes a landing
            self._after_disarm, self.reason = Phase.DONE, land_reason
        if telemetry.armed or not fresh:
            self._disarmed_since = None
        elif self._disarmed_since is None:
            self._disarmed_since = now
        if self._disarmed_since is not None and now - self._disarmed_since >= _DISARMED_S - 1e-6:
            self._enter(self._after_disarm, now, self.reason)
            return ()
        if telemetry.armed and telemetry.mode in (FlightMode.POSITION, FlightMode.MANUAL):
            self._release(now, f"a pilot has the vehicle in {telemetry.mode.value}")
            return ()
        if self._overdue(now, self.settings.land_deadline_s):
            self._release(now, f"not seen disarmed for {self.settings.land_deadline_s:.0f} s: left to the autopilot")
            return ()
        return self._ask(VehicleCommand.DISARM, now)

    def _climb(self, now: float, telemetry: Telemetry, land_reason: str | None) -> tuple[VehicleCommand, ...]:
        if self._left(now, telemetry):
            return ()
        if land_reason is None and self._overdue(now, self.settings.climb_deadline_s):
            land_reason = f"{self.settings.height_m:.1f} m was not reached, only {telemetry.height_m:.1f} m"
            self._events.append(Event(now, "failsafe", land_reason))
        if land_reason is not None:
            self._enter(Phase.LAND, now, land_reason)
            return self._ask(VehicleCommand.LAND, now)
        if telemetry.height_m >= self.settings.height_m - _HEIGHT_REACHED_M:
            self._advance(now, "exploring")
        return ()

    def _explore(self, now: float, telemetry: Telemetry, land_reason: str | None) -> tuple[VehicleCommand, ...]:
        if self._left(now, telemetry):
            return ()
        if land_reason is not None:
            self._enter(Phase.LAND, now, land_reason)
            return self._ask(VehicleCommand.LAND, now)
        return ()

    def _land(self, now: float, telemetry: Telemetry) -> tuple[VehicleCommand, ...]:
        if not telemetry.armed:
            self._enter(Phase.DONE, now, self.reason)
            return ()
        if self._overdue(now, self.settings.land_deadline_s):
            self._release(now, f"not on the ground after {self.settings.land_deadline_s:.0f} s: left to the autopilot")
            return ()
        if telemetry.mode is FlightMode.OFFBOARD:
            return self._ask(VehicleCommand.LAND, now)
        if telemetry.mode is not FlightMode.LAND:
            self._release(now, f"the autopilot left LAND for {telemetry.mode.value}")
        elif telemetry.landed:
            return self._ask(VehicleCommand.DISARM, now)
        return ()

    def _left(self, now: float, telemetry: Telemetry) -> bool:
        """Notice that the autopilot, or a pilot through it, took the vehicle out of the runner's hands."""
        if not telemetry.armed:
            self._release(now, "the vehicle was disarmed in flight, not by this runner")
        elif telemetry.mode is not FlightMode.OFFBOARD:
            self._release(now, f"the autopilot left OFFBOARD for {telemetry.mode.value}: pilot or failsafe has it")
        return self.phase is Phase.RELEASED

    def _release(self, now: float, reason: str) -> None:
        self._events.append(Event(now, "failsafe", reason))
        self._enter(Phase.RELEASED, now, reason)

    def _stay_down(self, now: float, telemetry: Telemetry, reason: str) -> tuple[VehicleCommand, ...]:
        if telemetry.armed:
            return self._ask(VehicleCommand.DISARM, now)
        self._enter(Phase.DONE, now, reason)
        return ()

    def _ask(self, command: VehicleCommand, now: float) -> tuple[VehicleCommand, ...]:
        """Return the command, or nothing while the last asking is younger than the retry time."""
        last = self._asked_at.get(command)
        if last is not None and now - last < self.settings.retry_s - 1e-6:
            return ()
        self._asked_at[command] = now
        return (command,)

    def _advance(self, now: float, reason: str) -> None:
        order = self.takeoff.phases
        self._enter(order[order.index(self.phase) + 1], now, reason)

    def _enter(self, phase: Phase, now: float, reason: str) -> None:
        self.phase, self.reason, self._since = phase, reason, now
        self._answer = ""
        self._asked_at = {}
        self._events.append(Event(now, "phase", f"{phase.value}: {reason}"))

    def _overdue(self, now: float, deadline_s: float) -> bool:
        return self._since is not None and now - self._since > deadline_s

    def _climb_speed(self, telemetry: Telemetry) -> float:
        """Proportional height control by climb speed, once armed and until landing; none by an old height."""
        if self.phase not in (Phase.CLIMB, Phase.EXPLORE) or telemetry.height_age_s > _TELEMETRY_FRESH_S:
            return 0.0
        s = self.settings
        # Taking off at a crawl would leave ground effect and landing gear late: full climb until close.
        wanted = s.height_gain * (s.height_m - telemetry.height_m)
        if self.phase is Phase.CLIMB:
            wanted = max(wanted, 0.25)
        return max(-s.climb_mps, min(s.climb_mps, wanted))
