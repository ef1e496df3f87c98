"""The networks: an actor that every drone shares, and a critic that only training needs.

One code path serves three paradigms, which differ in what the two networks see:

| paradigm | the actor sees | the critic sees |
| --- | --- | --- |
| `ctde` | the drone's own observation | that, and the whole level |
| `dtde` | the drone's own observation | the same |
| `ctce` | the observations of the whole team, and the whole level | the same |

`ctde` is centralised training with decentralised execution. A `ctce` policy cannot fly: it shows what knowing all is
worth.
"""

from imagine.train.networks.actor import Actor, Decisions, steers
from imagine.train.networks.computing import (
    Computing,
    DeviceName,
    Precision,
    at_precision,
    chosen_device,
    compute_dtype,
)
from imagine.train.networks.critic import Critic
from imagine.train.networks.encoders import LEVEL_CELLS, LEVEL_CHANNELS
from imagine.train.networks.gaussian import LOG_STD_RANGE, entropy, log_probability
from imagine.train.networks.settings import NetworkSettings

__all__ = [
    "LEVEL_CELLS", "LEVEL_CHANNELS", "LOG_STD_RANGE", "Actor", "Computing", "Critic", "Decisions", "DeviceName",
    "NetworkSettings", "Precision", "at_precision", "chosen_device", "compute_dtype", "entropy", "log_probability",
    "steers",
]  # fmt: skip
