"""One world explored the straightforward way: pymunk queries, numpy and plain Python, nothing compiled or batched.

It makes the step of `imagine.sim.exploration` from the same definitions by other means. So it is the reference that
the batched step is timed against, and a second opinion on its results.
"""

from imagine.sim.plain.exploration import PlainExploration, PlainStep

__all__ = ["PlainExploration", "PlainStep"]
