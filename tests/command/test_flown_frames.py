"""What drones report in frames of their own, brought into one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from imagine.core.frames import IDENTITY, Pose, compose, inverse
from imagine.flight_results import pose_rmse
from imagine.flown_map import sum_in_one_frame


def test_maps_of_one_frame_are_added_cell_by_cell() -> None:
    a, b = np.array([[1, -2], [0, 3]], np.int8), np.array([[7, 7]], np.int8)
    belief, corner = sum_in_one_frame([(a, np.array([-3, 5]), IDENTITY), (b, np.array([-2, 6]), IDENTITY)])
    assert corner == (-3, 5)
    assert belief.tolist() == [[1, -2, 0], [0, 8, 7]]  # 3 + 7 is clipped


def test_a_map_of_a_drone_that_began_turned_lies_where_it_was_seen() -> None:
    own = np.zeros((32, 32), np.int8)
    own[0, 5] = 6  # seen at x 0.55 m, y 0.05 m from where it began
    belief, corner = sum_in_one_frame([(own, np.array([0, 0]), Pose(2.0, 1.0, math.pi / 2))])
    ((row, column),) = np.argwhere(belief)
    x, y = (column + corner[0] + 0.5) * 0.1, (row + corner[1] + 0.5) * 0.1
    assert (x, y) == pytest.approx((1.95, 1.55))


def test_the_pose_error_is_that_in_the_twins_frame() -> None:
    launch = Pose(3.0, -2.0, 2.0)
    true = [Pose(3.0 + 0.1 * i, -2.0 + 0.05 * i, 2.0) for i in range(20)]
    truth = {100 * i: np.array([pose]) for i, pose in enumerate(true)}
    own = [[0.1 * i, *compose(inverse(launch), pose)] for i, pose in enumerate(true)]
    assert pose_rmse(own, truth, 0, launch) == pytest.approx(0.0, abs=1e-6)
    assert (pose_rmse(own, truth, 0) or 0.0) > 1.0
