"""What `imagine doctor` shows."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from imagine.core.errors import WorkError
from imagine.doctor import examine
from imagine.outputs import write_json

_STYLES = {"ok": "green", "missing": "yellow", "fault": "bold red"}


def examine_and_show(json_file: Path | None) -> None:
    """Print what was found. Raises WorkError where something is missing that every flight needs."""
    found = examine()
    table = Table(box=None, header_style="dim", pad_edge=False)
    table.add_column("what", no_wrap=True)
    table.add_column("state", no_wrap=True)
    table.add_column("found", overflow="fold")
    for finding in found:
        table.add_row(Text(finding.name), Text(finding.state, _STYLES[finding.state]), Text(finding.detail))
    Console().print(table)
    write_json(json_file, [asdict(finding) for finding in found])
    faults = [finding.name for finding in found if finding.state == "fault"]
    if faults:
        raise WorkError(f"drones cannot fly here until this is mended: {', '.join(faults)}")
