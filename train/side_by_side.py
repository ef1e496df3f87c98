"""Two pieces of work that do not touch each other, done at once, each on half of torch's threads.

Layers as small as ours gain little from a second thread and pay for its waiting: an update of actor and critic on two
threads each in turn costs a third more processor time than on one thread each side by side. The sums, too, are then
those of half the threads, whatever runs beside.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

One = TypeVar("One")
Other = TypeVar("Other")


def side_by_side(one: Callable[[], One], other: Callable[[], Other]) -> tuple[One, Other]:
    """Return what both return, once both have ended; what the first of them raises is raised then.

    With a single thread they run in turn.
    """
    threads = torch.get_num_threads()
    if threads < 2:
        return one(), other()
    torch.set_num_threads(threads // 2)  # a thread that is new to torch takes over this number
    try:
        with ThreadPoolExecutor(max_workers=1) as pool:
            later = pool.submit(other)
            first = one()
            return first, later.result()
    finally:
        torch.set_num_threads(threads)
