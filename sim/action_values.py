"""Actions as callers give them: arrays of any number type, or nested lists."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imagine.core.errors import InputError

_NUMBERS = "biuf"  # NumPy's kinds of bool, integers and floating point


def action_values(given: ArrayLike, name: str) -> NDArray[np.float32]:
    """Return what is given as float32, the same array where it is that already; `name` names it in errors.

    What float32 cannot hold becomes infinite. Raises InputError where anything is not a number or lists are ragged.
    """
    try:
        values = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: lists of unequal lengths: give an array of numbers") from error
    if values.dtype.kind not in _NUMBERS:
        raise InputError(f"{name}: not numbers but {values.dtype.name}: give an array of numbers")
    with np.errstate(over="ignore"):
        return values.astype(np.float32, copy=False)
