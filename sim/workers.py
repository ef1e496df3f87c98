"""Threads that share out a loop over worlds: compiled kernels release the interpreter, so plain threads suffice.

Numba's own parallel loops would start an OpenMP pool, which fights with torch's and resets its size, and take five
times as long to compile.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


class Workers:
    """Runs kernels `kernel(first, last, *arguments)` over parts of a range, on every core this process may use."""

    def __init__(self, threads: int | None = None) -> None:
        """Prepare `threads` threads; by default one for each core."""
        self.threads = threads or len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(self.threads, "worlds") if self.threads > 1 else None

    def over(self, count: int, kernel: Callable[..., None], *arguments: Any) -> None:
        """Run `kernel` over 0 to `count`, split into equal parts; return when all are done.

        Parts must not write to the same memory. An exception of any part is raised.
        """
        parts = min(self.threads, count)
        if self._pool is None or parts <= 1:
            kernel(0, count, *arguments)
            return
        bounds = [count * part // parts for part in range(parts + 1)]
        jobs = [self._pool.submit(kernel, first, last, *arguments) for first, last in itertools.pairwise(bounds[1:])]
        kernel(bounds[0], bounds[1], *arguments)
        for job in jobs:
            job.result()
