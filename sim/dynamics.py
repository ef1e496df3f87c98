"""How a drone answers to setpoints: lag, acceleration limit, drag, wind and delay, which may differ with every episode.

With velocity v, delayed setpoint u (map frame), wind w and drag d, the airframe's thrust and drag accelerate it by

    clip((u + w - v) / lag, acceleration) - d (v - w)

A substep integrates this exactly where the limit does not bind. So a hovering drone drifts with the wind, and one that
flies against drag is slower than asked for by the factor 1 / (1 + d lag).
"""

from __future__ import annotations

import math
from typing import Annotated

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.keyed_noise import key_of
from imagine.sim.randomisation import Quantity, ends, within

TICK_S = 0.1
"""Simulated time of one step: one LiDAR turn."""
SUBSTEPS = 5
SUBSTEP_S = TICK_S / SUBSTEPS
LONGEST_DELAY_S = 1.0
HISTORY = math.ceil(LONGEST_DELAY_S / TICK_S) + 2
"""Setpoints that are kept, one a tick: a delayed one may start within a substep."""


class DynamicsSettings(Settings):
    """How the airframe answers, SI units; a range [low, high] is drawn anew for every drone and episode."""

    lag_s: Annotated[Quantity, within(0.0, 2.0)] | None = Field(
        default=None, description="time constant from setpoint to velocity, s; left out: as the vehicle's limits say"
    )
    acceleration_mps2: Annotated[Quantity, within(0.1, 30.0)] | None = Field(
        default=None, description="greatest horizontal acceleration, m/s²; left out: as the vehicle's limits say"
    )
    drag_per_s: Annotated[Quantity, within(0.0, 5.0)] = Field(
        default=0.0, description="linear drag over mass: deceleration for each m/s through the air, 1/s"
    )
    mass_kg: Annotated[Quantity, within(0.01, 10.0)] = Field(
        default=0.087, description="mass, kg, which counts where drones push each other and crates; DJI Tello"
    )
    delay_s: Annotated[Quantity, within(0.0, LONGEST_DELAY_S)] = Field(
        default=0.0, description="time from a setpoint to its effect, s"
    )
    wind_mps: Annotated[Quantity, within(0.0, 2.0)] = Field(
        default=0.0, description="standard deviation of the drift along each axis, m/s (Ornstein-Uhlenbeck)"
    )
    wind_correlation_s: Annotated[Quantity, within(0.1, 600.0)] = Field(
        default=5.0, description="time over which the drift keeps its way, s"
    )

    def draw(self, rng: np.random.Generator, drones: int, limits: VehicleLimits) -> NDArray[np.float64]:
        """Return one episode's dynamics, `[drones, COLUMNS]`, columns as LAG to WIND_KEPT.

        Every field takes its numbers whether it is a range or not, so that a range in one leaves the others' alone.
        """
        fields = (
            limits.lag_s if self.lag_s is None else self.lag_s,
            limits.acceleration_mps2 if self.acceleration_mps2 is None else self.acceleration_mps2,
            self.drag_per_s, self.mass_kg, self.delay_s, self.wind_mps, self.wind_correlation_s,
        )  # fmt: skip
        low, high = np.array([ends(field) for field in fields]).T
        dynamics = np.zeros((drones, COLUMNS))
        dynamics[:, : len(fields)] = low + (high - low) * rng.random((drones, len(fields)))
        lag, drag = dynamics[:, LAG], dynamics[:, DRAG]
        # What a substep needs of them, once an episode: an exponential for every drone and substep would show.
        with np.errstate(divide="ignore"):
            dynamics[:, YAW_BLEND] = -np.expm1(-SUBSTEP_S / lag)
            dynamics[:, BLEND] = -np.expm1(-SUBSTEP_S * (1.0 / lag + drag))
        dynamics[:, REACHED] = 1.0 / (1.0 + drag * lag)
        dynamics[:, LOSS] = -np.expm1(-SUBSTEP_S * drag) / SUBSTEP_S
        dynamics[:, WIND_KEPT] = np.exp(-TICK_S / dynamics[:, CORRELATION])
        return dynamics


LAG, ACCELERATION, DRAG, MASS, DELAY, WIND, CORRELATION, YAW_BLEND, BLEND, REACHED, LOSS, WIND_KEPT = range(12)
COLUMNS = 12


# Kernels get whole arrays and indices: each slice made in an inner loop would count references, with a bus lock.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gauss(key, index):  # type: ignore[no-untyped-def]
    """Return the standard normal number `index` of the stream `key` (uint64)."""
    u = (np.float64(key_of(key, 2 * index) >> np.uint64(11)) + 1.0) / 9007199254740993.0
    v = np.float64(key_of(key, 2 * index + 1) >> np.uint64(11)) / 9007199254740992.0
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)  # Box and Muller 1958


@numba.njit(cache=True, nogil=True, error_model="numpy")
def blow(world, wind, dynamics, key, age):  # type: ignore[no-untyped-def]
    """Bring a world's wind (m/s, map frame) to its tick `age`: a sampled Ornstein-Uhlenbeck process.

    `wind` `[worlds, drones, 2]`, `dynamics` `[worlds, drones, COLUMNS]`, `key` uint64 of the world and episode.
    """
    drones = wind.shape[1]
    for drone in range(drones):
        std = dynamics[world, drone, WIND]
        if std == 0.0:
            continue
        keep = dynamics[world, drone, WIND_KEPT] if age > 0 else 0.0
        fresh = std * math.sqrt(1.0 - keep * keep)
        for axis in range(2):
            number = _gauss(key, (age * drones + drone) * 2 + axis)
            wind[world, drone, axis] = keep * wind[world, drone, axis] + fresh * number


@numba.njit(cache=True, nogil=True, error_model="numpy")
def keep_setpoint(world, drone, history, age, setpoints, speed, yaw_rate):  # type: ignore[no-untyped-def]
    """Put tick `age`'s setpoint (forward, left, yaw rate), cut to the limits, into the ring `[..., HISTORY, 3]`."""
    forward, left, rate = setpoints[world, drone, 0], setpoints[world, drone, 1], setpoints[world, drone, 2]
    size = math.sqrt(forward * forward + left * left)
    if size > speed:
        forward, left = forward * speed / size, left * speed / size
    slot = age % HISTORY
    history[world, drone, slot, 0], history[world, drone, slot, 1] = forward, left
    history[world, drone, slot, 2] = min(max(rate, -yaw_rate), yaw_rate)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def delayed(world, drone, history, age, substep, delay_s):  # type: ignore[no-untyped-def]
    """Return the mean setpoint (forward, left, yaw rate) that acts during a substep of tick `age`.

    `history` `[worlds, drones, HISTORY, 3]` is a ring with one setpoint a tick; before the first one drones hover.
    """
    late = delay_s / SUBSTEP_S
    whole = int(late)
    since = age * SUBSTEPS + substep - whole
    newer, older = since // SUBSTEPS, (since - 1) // SUBSTEPS
    old = late - whole if older != newer else 0.0
    new = 1.0 - old if newer >= 0 else 0.0
    old = old if older >= 0 else 0.0
    a, b = newer % HISTORY, older % HISTORY
    return (
        new * history[world, drone, a, 0] + old * history[world, drone, b, 0],
        new * history[world, drone, a, 1] + old * history[world, drone, b, 1],
        new * history[world, drone, a, 2] + old * history[world, drone, b, 2],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def acceleration_for(world, drone, forward, left, yaw, vx, vy, wind, dynamics):  # type: ignore[no-untyped-def]
    """Return the acceleration (m/s², map frame) of a substep toward a body setpoint; arrays as `blow` takes them."""
    wind_x, wind_y = wind[world, drone, 0], wind[world, drone, 1]
    c, s = math.cos(yaw), math.sin(yaw)
    reached, rate = dynamics[world, drone, REACHED], dynamics[world, drone, BLEND] / SUBSTEP_S
    loss, limit = dynamics[world, drone, LOSS], dynamics[world, drone, ACCELERATION]
    drag_x, drag_y = loss * (vx - wind_x), loss * (vy - wind_y)
    ax = ((c * forward - s * left) * reached + wind_x - vx) * rate + drag_x
    ay = ((s * forward + c * left) * reached + wind_y - vy) * rate + drag_y
    size = math.sqrt(ax * ax + ay * ay)
    if size > limit:
        ax, ay = ax * limit / size, ay * limit / size
    return ax - drag_x, ay - drag_y
