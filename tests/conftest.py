"""What all tests share: property tests without a stop-watch, since kernels compile and machines are busy."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

settings.register_profile("imagine", deadline=None, max_examples=50, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("imagine")
