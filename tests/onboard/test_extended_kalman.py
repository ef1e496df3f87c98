"""The filter is filterpy's own, loaded alone."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from imagine.onboard.extended_kalman import ExtendedKalmanFilter


def test_it_estimates_as_filterpys_own_does() -> None:
    from filterpy.kalman import ExtendedKalmanFilter as WholePackagesFilter

    estimates = []
    for kind in (ExtendedKalmanFilter, WholePackagesFilter):
        filter_ = kind(dim_x=2, dim_z=1)
        filter_.F = np.array([[1.0, 0.1], [0.0, 1.0]])
        for k in range(20):
            filter_.predict()
            filter_.update(np.array([[0.1 * k]]), lambda x: np.array([[1.0, 0.0]]), lambda x: x[:1])
        estimates.append((filter_.x, filter_.P, filter_.log_likelihood))
    for alone, whole in zip(*estimates, strict=True):
        assert np.array_equal(alone, whole)
    assert estimates[0][0][1, 0] > 0.5


def test_a_runner_starts_without_filterpys_statistics() -> None:
    code = (
        "import sys, imagine.onboard.process; "
        "print([m for m in ('scipy.stats', 'scipy.ndimage', 'filterpy', 'torch') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert told.stdout.strip() == "[]"
