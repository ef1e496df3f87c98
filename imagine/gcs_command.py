"""`imagine gcs`: the ground station of a real fleet, its page and a live table."""

from __future__ import annotations

import contextlib
import json
import os
import threading
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.live import Live

from imagine.core.config import load_settings
from imagine.gcs.station import StationSettings, run_station
from imagine.gcs.table import render
from imagine.mesh_comm.keys import find_keys


def watch_fleet(
    config: Path | None, mesh: str | None, key_file: Path | None, port: int | None, overrides: Sequence[str]
) -> None:
    """Run the ground station until Ctrl-C. Raises InputError on bad settings, a missing key or a port in use."""
    flags = [f"mesh={json.dumps(mesh)}"] if mesh is not None else []
    flags += [f"port={port}"] if port is not None else []
    settings = load_settings(StationSettings, config, [*flags, *overrides])
    keys = find_keys(key_file, os.environ)
    with Live(console=Console(), auto_refresh=False) as live, contextlib.suppress(KeyboardInterrupt):
        run_station(
            settings,
            keys,
            lambda url: live.console.print(f"ground station: {url}"),
            lambda snapshot: live.update(render(snapshot, live.console.width), refresh=True),
            threading.Event(),
        )
