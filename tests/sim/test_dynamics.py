"""How a drone answers: step responses as the equations say, delay to the substep, wind and drag, and what is drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.config import check_settings
from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.dynamics import (
    ACCELERATION,
    CORRELATION,
    DELAY,
    DRAG,
    LAG,
    MASS,
    SUBSTEP_S,
    TICK_S,
    WIND,
    DynamicsSettings,
)
from imagine.sim.level import load_level
from imagine.sim.twin import Twin

FEW_BEAMS = LidarSpec(beams=4)
ROOM = load_level("0")


def alone(dynamics: DynamicsSettings, heading: float = 0.0) -> Twin:
    twin = Twin([ROOM], 1, FEW_BEAMS, dynamics=dynamics)
    twin.set_level(0, ROOM, [Pose(1.0, 3.0, heading)])
    return twin


def response(twin: Twin, setpoint: tuple[float, float, float], ticks: int) -> NDArray[np.float64]:
    """Return velocities `[ticks, 3]` after each tick of one setpoint."""
    flown = []
    for _ in range(ticks):
        twin.step(np.array([[setpoint]]))
        flown.append(twin.velocity[0, 0].copy())
    return np.array(flown)


def test_a_small_step_is_answered_by_the_lag() -> None:
    times = TICK_S * np.arange(1, 13)
    straight = response(alone(DynamicsSettings(lag_s=0.3)), (0.5, 0.0, 0.0), 12)
    np.testing.assert_allclose(straight[:, 0], 0.5 * (1.0 - np.exp(-times / 0.3)), rtol=1e-9)
    turning = response(alone(DynamicsSettings(lag_s=0.3)), (0.0, 0.0, 1.0), 12)
    np.testing.assert_allclose(turning[:, 2], 1.0 - np.exp(-times / 0.3), rtol=1e-9)


def test_a_large_step_climbs_at_the_acceleration_limit_and_ends_in_the_lag() -> None:
    velocity = response(alone(DynamicsSettings(lag_s=0.15, acceleration_mps2=1.0)), (0.8, 0.0, 0.0), 20)[:, 0]
    np.testing.assert_allclose(velocity[:6], 0.1 * np.arange(1, 7), rtol=1e-9)  # (0.8 - v) / 0.15 is more than 1
    left = 0.8 - velocity
    np.testing.assert_allclose(left[9:] / left[8:-1], math.exp(-TICK_S / 0.15), rtol=1e-6)


def test_drag_slows_down_to_the_stated_share_and_stays_exact() -> None:
    velocity = response(alone(DynamicsSettings(lag_s=0.3, drag_per_s=1.5)), (0.5, 0.0, 0.0), 40)[:, 0]
    reached, rate = 0.5 / (1.0 + 1.5 * 0.3), 1.0 / 0.3 + 1.5
    times = TICK_S * np.arange(1, 41)
    np.testing.assert_allclose(velocity, reached * (1.0 - np.exp(-rate * times)), rtol=1e-9)


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.05, 0.13, 0.5, 1.0])
def test_a_setpoint_acts_after_the_delay_to_the_fraction_of_a_substep(delay_s: float) -> None:
    # Without lag, and at an acceleration that never ends, distance flown is speed times the time that is left.
    twin = alone(DynamicsSettings(lag_s=0.0, acceleration_mps2=30.0, delay_s=delay_s))
    response(twin, (0.4, 0.0, 0.0), 20)
    assert twin.poses[0, 0, 0] - 1.0 == pytest.approx(0.4 * (2.0 - delay_s - SUBSTEP_S), abs=1e-6)
    # the solver moves bodies by the velocity of the substep before, hence one substep less
    response(twin, (0.0, 0.0, 0.0), 20)
    assert twin.poses[0, 0, 0] - 1.0 == pytest.approx(0.4 * 2.0, abs=1e-6)


def test_the_wind_carries_a_hovering_drone_and_has_the_stated_spread_and_memory() -> None:
    settings = DynamicsSettings(wind_mps=0.2, wind_correlation_s=0.5)
    twin = Twin([ROOM] * 64, 4, FEW_BEAMS, dynamics=settings)
    hover = np.zeros((64, 4, 3))
    winds = []
    for _ in range(60):
        twin.step(hover)
        winds.append(twin.wind.copy())
    wind = np.array(winds)
    assert wind[0].std() == pytest.approx(0.2, rel=0.1)  # from the first tick on
    assert wind.std() == pytest.approx(0.2, rel=0.05)
    assert abs(wind.mean()) < 0.02
    later = (wind[5:] * wind[:-5]).mean() / (wind**2).mean()
    assert later == pytest.approx(math.exp(-1.0), abs=0.06)  # five ticks are one correlation time
    axes = np.corrcoef(wind[..., 0].ravel(), wind[..., 1].ravel())[0, 1]
    drones = np.corrcoef(wind[:, :, 0].ravel(), wind[:, :, 1].ravel())[0, 1]
    assert abs(axes) < 0.05
    assert abs(drones) < 0.05


def test_a_hovering_drone_drifts_with_a_steady_wind_and_one_that_flies_is_shifted_by_it() -> None:
    twin = alone(DynamicsSettings(wind_mps=0.2, wind_correlation_s=600.0, drag_per_s=0.7), 1.0)
    hovering = response(twin, (0.0, 0.0, 0.0), 20)[-1, :2]
    np.testing.assert_allclose(hovering, twin.wind[0, 0], atol=0.01)
    flying = response(twin, (0.3, 0.0, 0.0), 20)[-1, :2]
    through_air = flying - twin.wind[0, 0]
    expected = 0.3 / (1.0 + 0.7 * 0.15) * np.array([math.cos(1.0), math.sin(1.0)])
    np.testing.assert_allclose(through_air, expected, atol=0.01)


def test_defaults_are_the_limits_without_wind_drag_or_delay() -> None:
    drawn = DynamicsSettings().draw(np.random.default_rng(0), 3, VehicleLimits(lag_s=0.2, acceleration_mps2=3.0))
    for column, value in {LAG: 0.2, ACCELERATION: 3.0, DRAG: 0.0, MASS: 0.087, DELAY: 0.0, WIND: 0.0}.items():
        assert (drawn[:, column] == value).all()


def test_ranges_are_drawn_within_bounds_for_every_drone_and_episode_and_alone() -> None:
    ranged = DynamicsSettings(lag_s=(0.1, 0.3), mass_kg=(0.08, 0.12), delay_s=(0.0, 0.1))
    twin = Twin([ROOM] * 3, 4, FEW_BEAMS, dynamics=ranged)
    first = twin.drawn_dynamics.copy()
    assert ((first[..., LAG] >= 0.1) & (first[..., LAG] <= 0.3)).all()
    assert len(np.unique(first[..., LAG])) == 12
    twin.set_level(1, ROOM, ROOM.launch_poses(4))
    assert not np.isin(twin.drawn_dynamics[1, :, LAG], first[..., LAG]).any()
    np.testing.assert_array_equal(twin.drawn_dynamics[[0, 2]], first[[0, 2]])
    # a range in one field leaves what others draw alone, and so does the number of worlds
    also_wind = ranged.model_copy(update={"wind_mps": (0.1, 0.2)})
    single = Twin([ROOM], 4, FEW_BEAMS, dynamics=also_wind, world_keys=[2])
    for column in (LAG, ACCELERATION, DRAG, MASS, DELAY, CORRELATION):
        np.testing.assert_array_equal(single.drawn_dynamics[0, :, column], first[2, :, column])
    assert (single.drawn_dynamics[0, :, WIND] > 0.1).all()


def test_a_range_the_wrong_way_round_or_out_of_bounds_is_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"lag_s: give a number, or a range \[low, high\], within 0 and 2"):
        check_settings(DynamicsSettings, {"lag_s": [0.3, 0.1]}, "settings")
    with pytest.raises(InputError, match=r"delay_s: .* within 0 and 1"):
        check_settings(DynamicsSettings, {"delay_s": 1.5}, "settings")
    given = check_settings(DynamicsSettings, {"wind_mps": [0.0, 0.3]}, "settings")
    assert given.wind_mps == (0.0, 0.3)
