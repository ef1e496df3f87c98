"""Threads that share out a loop over worlds: compiled kernels release the interpreter, so plain threads suffice.

Numba's own parallel loops would start an OpenMP pool, which fights with torch's and resets its size, and take five
times as long to compile.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any


class Workers:
    """Runs kernels `kernel(first, last, *arguments)` over parts of a range, on every core this process may use."""

    def __init__(self, threads: int | None = None) -> None:
        """Prepare `threads` threads; by default as many as IMAGINE_THREADS says, or else one for each core."""
        self.threads = threads or _threads_here()
        self._pool = ThreadPoolExecutor(self.threads, "worlds") if self.threads > 1 else None

    def over(
        self, count: int, kernel: Callable[..., None], *arguments: Any, scratch: Sequence[Any] | None = None
    ) -> None:
        """Run `kernel` over 0 to `count`, split into equal parts; return when all are done.

        Parts must not write to the same memory: of `scratch`, each gets one as its last argument. An exception of any
        part is raised.
        """
        parts = max(1, min(self.threads, count))
        bounds = [count * part // parts for part in range(parts + 1)]
        own = [() if scratch is None else (scratch[part],) for part in range(parts)]
        jobs = []
        if self._pool is not None:
            jobs = [
                self._pool.submit(kernel, bounds[part], bounds[part + 1], *arguments, *own[part])
                for part in range(1, parts)
            ]
        kernel(bounds[0], bounds[1], *arguments, *own[0])
        for job in jobs:
            job.result()


def _threads_here() -> int:
    """Return how many threads this process may keep busy: where many share a machine, each is told its part."""
    told = os.environ.get("IMAGINE_THREADS", "")
    return max(1, int(told)) if told.isdecimal() else len(os.sched_getaffinity(0))
