"""Threads that share out a range: every part once, and a failure in any of them is heard."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.sim.workers import Workers


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 4, 7, 24])
def test_every_item_is_done_once(threads: int, count: int) -> None:
    done = np.zeros(count, np.int64)

    def kernel(first: int, last: int, out: NDArray[np.int64], step: int) -> None:
        out[first:last] += step

    Workers(threads).over(count, kernel, done, 3)
    assert done.tolist() == [3] * count


@pytest.mark.parametrize("bad", [0, 5, 9])
def test_a_failure_in_any_part_is_raised(bad: int) -> None:
    def kernel(first: int, last: int) -> None:
        if first <= bad < last:
            raise ZeroDivisionError(bad)

    with pytest.raises(ZeroDivisionError):
        Workers(3).over(10, kernel)
