"""Training: imitation of the frontier planner, then PPO, and the evaluation of what came out of it."""

import os

# Torch's idle OpenMP threads would spin on the cores that the twin's threads need. OpenMP reads this once, when it is
# loaded: it must stand before the first import of torch.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
