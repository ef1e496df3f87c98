"""Training: imitation of the frontier planner, then PPO, and the evaluation of what came out of it."""

import os

# Numba's threads and torch's OpenMP pool spin against each other while idle (a rollout step takes fifteen times as
# long). OpenMP reads this once, when it is loaded: it must stand before the first import of torch.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
