"""filterpy's extended Kalman filter without the rest of filterpy.

Importing the package loads scipy.stats and scipy.ndimage for filters that do not fly here: two fifths of the CPU time
that a runner takes to start. Only the filter's own module and the two functions it calls are loaded.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from types import ModuleType
from typing import Any

_PACKAGES = ("filterpy", "filterpy.common", "filterpy.kalman", "filterpy.stats")


def _load_filter() -> Any:
    """Import the filter's module while stand-ins take the place of its packages, and take them away again."""
    spec = importlib.util.find_spec("filterpy")
    if "filterpy" in sys.modules or spec is None or not spec.submodule_search_locations:
        return importlib.import_module("filterpy.kalman").ExtendedKalmanFilter
    root = spec.submodule_search_locations[0]
    stand_ins = {name: ModuleType(name) for name in _PACKAGES}
    for name, module in stand_ins.items():
        module.__path__ = [root + name.removeprefix("filterpy").replace(".", "/")]
    stand_ins["filterpy.stats"].__dict__["logpdf"] = _logpdf
    sys.modules.update(stand_ins)
    try:
        functions = importlib.import_module("filterpy.common.helpers")
        stand_ins["filterpy.common"].__dict__.update(pretty_str=functions.pretty_str, reshape_z=functions.reshape_z)
        return importlib.import_module("filterpy.kalman.EKF").ExtendedKalmanFilter
    except (ImportError, AttributeError):  # another filterpy, laid out otherwise: load the whole of it
        pass
    finally:
        _forget()
    return importlib.import_module("filterpy.kalman").ExtendedKalmanFilter


def _forget() -> None:
    """Take filterpy and its stand-ins out of the loaded modules."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "filterpy"]:
        del sys.modules[name]


def _logpdf(*args: Any, **kwargs: Any) -> Any:
    """Return filterpy's log density, which only the filter's likelihood needs; loads the whole package."""
    return importlib.import_module("filterpy.stats").logpdf(*args, **kwargs)


ExtendedKalmanFilter: Any = _load_filter()
