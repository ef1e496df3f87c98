"""Real-time pacing on a clock that the test drives."""

from __future__ import annotations

import pytest

from imagine.core.errors import InputError
from imagine.sim.pacing import Schedule


def test_ticks_keep_the_schedule_although_each_starts_a_little_late() -> None:
    schedule = Schedule(0.1, speed=2.0)
    due = schedule.next_due(10.0)
    for _ in range(100):
        due = schedule.next_due(due + 0.004)
    assert due == pytest.approx(10.0 + 101 * 0.05)
    assert schedule.late == 0


def test_a_short_delay_is_caught_up_and_a_long_one_starts_the_schedule_anew() -> None:
    schedule = Schedule(0.1)
    schedule.next_due(0.0)
    assert schedule.next_due(0.25) == pytest.approx(0.2)
    assert schedule.next_due(5.0) == pytest.approx(5.1)
    assert schedule.late == 2


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    with pytest.raises(InputError, match="speed"):
        Schedule(0.1, speed)
