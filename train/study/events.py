"""What happens to a study's trials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

Kind = Literal["started", "reported", "ended", "taken up again", "failed"]


@dataclass(frozen=True)
class Event:
    """Something that happened to a trial; `numbers` are those it reported last, `pid` and `host` of its worker."""

    trial: str
    kind: Kind
    numbers: dict[str, float] = field(default_factory=dict)
    pid: int | None = None
    host: str = ""
    error: str = ""


Tell = Callable[[Event], None]
