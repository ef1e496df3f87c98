"""The committed datagrams and their contents: this code reads and writes exactly what others are told to."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from imagine.mesh_comm import messages
from imagine.mesh_comm.seal import Sealer
from imagine.mesh_comm.vectors import content, vectors

FILE = Path(__file__).with_name("vectors.json")
LISTED: dict[str, Any] = json.loads(FILE.read_text())
ROWS = LISTED["datagrams"]


def test_every_kind_is_there() -> None:
    assert {row["kind"] for row in ROWS} == {"Scan", "Tiles", "Digest", "Status", "Command", "Here", "Sketch"}
    assert LISTED["wire_version"] == messages.WIRE_VERSION


@pytest.mark.parametrize("row", ROWS, ids=[f"{k}-{row['kind']}" for k, row in enumerate(ROWS)])
def test_a_datagram_is_opened_read_and_written_again(row: dict[str, Any]) -> None:
    datagram = bytes.fromhex(row["datagram"])
    assert len(datagram) <= messages.MAX_DATAGRAM
    opened = Sealer(bytes.fromhex(LISTED["key"]), 254, 1).open(datagram, 0.0)
    assert (opened.sender, opened.boot, opened.payload.hex()) == (row["sender"], LISTED["boot"], row["payload"])
    message = messages.decode(opened.payload)
    assert type(message).__name__ == row["kind"]
    assert content(message) == row["content"]
    assert messages.encode(message).hex() == row["payload"]


def test_contents_are_packed_into_the_same_bytes() -> None:
    assert vectors() == LISTED


def test_the_module_writes_the_file(tmp_path: Path) -> None:
    written = tmp_path / "vectors.json"
    subprocess.run([sys.executable, "-m", "imagine.mesh_comm.vectors", str(written)], check=True, timeout=60)
    assert written.read_bytes() == FILE.read_bytes()
