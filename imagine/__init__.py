"""IMAGINE: small drones that explore unknown indoor spaces together."""

from imagine.kernel_cache import use_kernel_cache

__version__ = "0.1.0"

use_kernel_cache()
