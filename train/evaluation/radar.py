"""Six qualities of a policy on one scale, 0 to 1, where 1 is best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

AXES = ("coverage", "speed", "little overlap", "few contacts", "few bytes", "balanced work")


def radar_of(rows: Sequence[dict[str, Any]]) -> NDArray[np.float64]:
    """Return `[rows, 6]` by AXES, for rows of one team size.

    Coverage: the mean share. Speed: the least mean T90 of the rows per the own. Little overlap: 1 where no cell was
    seen by two drones, 0 where every cell was seen by all. Few contacts: 1 / (1 + contacts a drone). Few bytes: the
    least sent of the rows per the own. Balanced work: what the least productive drone discovered per the most
    productive one. Speed and bytes so depend on who is compared.
    """
    fastest = min(row["t90_mean"] for row in rows)
    leanest = min(row["bytes_per_drone"] for row in rows)
    return np.array(
        [
            (
                row["coverage_mean"],
                fastest / row["t90_mean"],
                _apart(row["overlap"], row["drones"]),
                1.0 / (1.0 + row["collisions_per_drone"]),
                leanest / row["bytes_per_drone"] if row["bytes_per_drone"] > 0.0 else 1.0,
                1.0 / row["productivity_ratio"],
            )
            for row in rows
        ]
    )


def _apart(overlap: float, drones: int) -> float:
    """Return 1 for an overlap of 1, 0 where all drones saw everything; alone there is none."""
    return 1.0 if drones == 1 else float(np.clip((drones - overlap) / (drones - 1), 0.0, 1.0))
