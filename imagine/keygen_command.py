"""`imagine keygen`: makes and changes the files that hold a swarm's keys, and says where they go."""

from __future__ import annotations

import time
from pathlib import Path

from imagine.mesh_comm.keys import rotate_keys, write_new_keys

_HOUR_S = 3600.0


def make_keys(out: Path, ground: Path | None) -> None:
    """Write new key files. Raises InputError if one exists or cannot be written."""
    write_new_keys(out, ground)
    if ground is None:
        print(f"{out}: a new key, readable by you alone; copy it to every drone and the ground station")
    else:
        print(f"{out}: a new key, readable by you alone; copy it to every drone")
        print(f"{ground}: the same with the signing key of orders; for the ground station only")


def renew_keys(out: Path, ground: Path | None, after_h: float, overlap_h: float) -> None:
    """Add a key to key files, and let the others end. Raises InputError on files that are no such pair."""
    ring = rotate_keys(out, ground, time.time(), after_h * _HOUR_S, overlap_h * _HOUR_S)
    files = str(out) if ground is None else f"{out}, {ground}"
    print(f"{files}: key {ring.keys[-1].id:02x} added; it sends in {after_h:g} h, the others end {overlap_h:g} h later")
    print("copy them to where the old ones are, and start every node anew, before the new key sends")
