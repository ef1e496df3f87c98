"""How fast the batched step is: against the plain ones in the same run, and as worlds and drones grow in number.

An agent-step is one drone deciding once: 0.1 s of simulated time. Rates are told per second of the wall clock, with
as many cores as the batched step takes, and per second of CPU time. Machines are noisy: what is compared is measured
in turns, and medians are told.
"""

from imagine.sim.bench.plan import BenchPlan, Results
from imagine.sim.bench.twin import bench_twin

__all__ = ["BenchPlan", "Results", "bench_twin"]
