"""One world explored the straightforward way: pymunk queries, numpy, plain Python, and the mesh nodes that fly.

It makes the step of `imagine.sim.exploration` from the same definitions by other means, with nothing batched and
nothing compiled but what it is told to take. So it is the reference that the batched step is timed against, and a
second opinion on its results.
"""

from imagine.sim.plain.exploration import PlainExploration, PlainStep

__all__ = ["PlainExploration", "PlainStep"]
