"""The byte budget of a radio: a token bucket driven by the caller's time."""

from __future__ import annotations


class TokenBucket:
    """Lets at most `rate_bytes_per_s * window + burst_bytes` bytes pass in any window of time."""

    def __init__(self, rate_bytes_per_s: float, burst_bytes: float) -> None:
        """Start with a full bucket."""
        self.rate_bytes_per_s = rate_bytes_per_s
        self.burst_bytes = burst_bytes
        self._tokens = burst_bytes
        self._filled_at: float | None = None

    def take(self, size: int, now: float) -> bool:
        """Take `size` bytes out at time `now` (seconds) if they are there; tell whether they were.

        Time that runs backwards fills nothing.
        """
        if self._filled_at is None:
            self._filled_at = now
        elapsed = max(0.0, now - self._filled_at)
        self._filled_at = max(self._filled_at, now)
        self._tokens = min(self.burst_bytes, self._tokens + elapsed * self.rate_bytes_per_s)
        if size > self._tokens:
            return False
        self._tokens -= size
        return True
