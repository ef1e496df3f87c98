"""The chances that tiles and scans are packed by: a small table that every node must have alike, in `chances.json`.

`python -m imagine.sim.codec_fit` counts them anew on flights. New chances mean a new `messages.WIRE_VERSION`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.mesh_comm.range_coder import LEAST, ONE
from imagine.mesh_comm.scan_model import SCAN_CONTEXTS
from imagine.mesh_comm.tile_model import TILE_CONTEXTS

PATH = Path(__file__).with_name("chances.json")


class Chances(NamedTuple):
    """Chances that a bit is zero, of 65536, by context; int64, not to be changed.

    `tile` `[TILE_CONTEXTS]` stay as they are, `scan` `[SCAN_CONTEXTS]` are where each scan starts to learn.
    """

    tile: NDArray[np.int64]
    scan: NDArray[np.int64]


def load_chances(path: Path = PATH) -> Chances:
    """Read the table. Raises ValueError where it is not one of this version's contexts."""
    table = json.loads(path.read_text())
    chances = Chances(np.array(table["tile"], np.int64), np.array(table["scan"], np.int64))
    for found, contexts in zip(chances, (TILE_CONTEXTS, SCAN_CONTEXTS), strict=True):
        if found.shape != (contexts,) or found[0] != ONE // 2 or found.min() < LEAST or found.max() > ONE - LEAST:
            raise ValueError(f"{path}: {len(found)} chances, expected {contexts} from {LEAST} to {ONE - LEAST}")
    return chances


def write_chances(chances: Chances, path: Path = PATH) -> None:
    """Write the table, twenty numbers a line."""
    parts = []
    for name, numbers in chances._asdict().items():
        lines = [", ".join(map(str, numbers[k : k + 20].tolist())) for k in range(0, len(numbers), 20)]
        parts.append(f'"{name}": [\n' + ",\n".join(lines) + "\n]")
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n")


def count_chances(ones: NDArray[np.int64], seen: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the chances of zero of contexts that were seen so often, and so often with a one: Krichevsky, Trofimov.

    A context never seen is at even odds, and so is context 0 always.
    """
    zero = np.rint(ONE * (seen - ones + 0.5) / (seen + 1.0)).astype(np.int64)
    zero[0] = ONE // 2
    return np.clip(zero, LEAST, ONE - LEAST)
