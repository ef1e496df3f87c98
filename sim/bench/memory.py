"""How much memory something takes: the arrays it holds, what the process grew by, and what the machine has left."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

_CGROUP = Path("/sys/fs/cgroup")


def array_bytes(root: Any) -> int:
    """Return the bytes of all numpy arrays reachable from an object of this project, each counted once.

    Looks into containers and into the attributes of this project's own objects, and nowhere else.
    """
    total, met, waiting = 0, set(), [root]
    while waiting:
        found = waiting.pop()
        while isinstance(found, np.ndarray) and isinstance(found.base, np.ndarray):
            found = found.base  # a view holds the array it looks at
        if id(found) in met:
            continue
        met.add(id(found))
        if isinstance(found, np.ndarray):
            total += found.nbytes
        elif isinstance(found, dict):
            waiting += found.values()
        elif isinstance(found, list | tuple | set | frozenset):
            waiting += found
        elif type(found).__module__.partition(".")[0] == "imagine" and not isinstance(found, type):
            waiting += getattr(found, "__dict__", {}).values()
            names = (name for kind in type(found).__mro__ for name in getattr(kind, "__slots__", ()))
            waiting += [getattr(found, name) for name in names if hasattr(found, name)]
    return total


def resident_bytes() -> int:
    """Return this process's resident memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def free_bytes() -> int:
    """Return how much memory this process may still take: the machine's, or less where its control group has less."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    try:
        most, used = ((_CGROUP / name).read_text().strip() for name in ("memory.max", "memory.current"))
    except OSError:  # no control group of version 2, or not its root
        return free
    return free if most == "max" else max(0, min(free, int(most) - int(used)))
