"""The table of `imagine bench seal`."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from imagine.mesh_comm.seal_bench import bench_seal
from imagine.outputs import write_json


def bench_seal_and_show(datagrams: int, json_file: Path | None) -> None:
    """Measure, print a table, and write what was asked for."""
    results = bench_seal(datagrams)
    table = Table(box=None, header_style="dim", pad_edge=False)
    table.add_column("what")
    table.add_column("bytes", justify="right")
    table.add_column("datagrams/s of CPU time", justify="right")
    for name, row in results.items():
        table.add_row(name.replace("_", " "), str(row["bytes"]), f"{row['value']:,.0f}")
    Console().print(table)
    write_json(json_file, results)
