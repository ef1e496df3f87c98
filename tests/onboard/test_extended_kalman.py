"""The filter is filterpy's own, loaded alone."""

from __future__ import annotations

import importlib
import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest

from imagine.onboard import extended_kalman
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


@pytest.mark.parametrize("error", [ImportError, AttributeError])
def test_a_filterpy_laid_out_otherwise_is_loaded_whole(monkeypatch: pytest.MonkeyPatch, error: type[Exception]) -> None:
    imported = importlib.import_module

    def without_helpers(name: str, package: str | None = None) -> ModuleType:
        if name == "filterpy.common.helpers":
            raise error(name)
        return imported(name, package)

    for name in [name for name in sys.modules if name.partition(".")[0] == "filterpy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(importlib, "import_module", without_helpers)
    loaded = extended_kalman._load_filter()
    assert loaded is imported("filterpy.kalman").ExtendedKalmanFilter


def test_a_runner_starts_without_filterpys_statistics() -> None:
    code = (
        "import sys, imagine.onboard.process; "
        "print([m for m in ('scipy.stats', 'scipy.ndimage', 'filterpy', 'torch') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert told.stdout.strip() == "[]"
