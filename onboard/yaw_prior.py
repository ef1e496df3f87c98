"""The autopilot's yaw as a prior for odometry: continuous, and absent while its telemetry is old."""

from __future__ import annotations

import math

from imagine.core.frames import wrap_angle
from imagine.onboard.records import Telemetry

_FRESH_S = 0.3
_SLACK_RAD = 0.1


class YawPrior:
    """Takes jumps out of the autopilot's yaw: its estimator resets it when external odometry first arrives."""

    def __init__(self, fastest_rps: float) -> None:
        """`fastest_rps` is the greatest yaw rate flown; a faster change is a reset, not a turn."""
        self.fastest_rps = fastest_rps
        self._offset = 0.0
        self._last: Telemetry | None = None

    def at(self, now: float, telemetry: Telemetry | None) -> float | None:
        """Return the yaw of this tick's telemetry, radians, up to a constant; None where it is missing or too old."""
        if telemetry is None or now - telemetry.stamp > _FRESH_S:
            return None
        if self._last is not None:
            dt = max(0.0, telemetry.stamp - self._last.stamp)
            step = wrap_angle(telemetry.yaw - self._last.yaw)
            if abs(step) > 1.5 * self.fastest_rps * dt + _SLACK_RAD:
                turned = 0.5 * (telemetry.yaw_rate + self._last.yaw_rate) * dt
                self._offset += turned - step
        self._last = telemetry
        return wrap_angle(math.fsum((telemetry.yaw, self._offset)))
