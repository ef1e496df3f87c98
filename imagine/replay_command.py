"""What `imagine replay` shows: progress, then the figures."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from imagine.onboard.replay import replay_file


def replay_and_show(recording: Path, json_file: Path | None, map_file: Path | None, verify: bool) -> None:
    """Replay a LiDAR recording, write what is wanted, and print the outcome."""
    console = Console(stderr=True)
    with Progress(transient=True, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(recording.name, total=None)
        result = replay_file(
            recording,
            None,
            json_file,
            map_file,
            verify,
            lambda done, total: bar.update(task, completed=done, total=total),
        )
    found = result.as_json()
    table = Table(title=f"replay of {recording.name}", show_header=False, title_justify="left")
    table.add_row("scans", str(found["scans"]))
    table.add_row("tracked", str(found["tracked"]))
    error = f"{found['ate_rmse_m']:.3f} m" if "ate_rmse_m" in found else "no reference"
    table.add_row("position error, rms", error)
    times = found["scan_ms"]
    table.add_row("time a scan", f"{times['p50']:.1f} ms median, {times['p99']:.1f} ms worst in 100")
    table.add_row("verified", "the same, bit for bit" if verify else "not asked for")
    Console().print(table)
