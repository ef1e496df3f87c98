"""The project's texts are finished."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def unfilled(text: str) -> list[str]:
    """Return the lines, with their numbers, that hold a slot: a template's braces, or a table cell of "…" alone."""
    return [
        f"{number}: {line.strip()}"
        for number, line in enumerate(text.splitlines(), start=1)
        if "{{" in line or (line.lstrip().startswith("|") and "…" in [cell.strip(" `*") for cell in line.split("|")])
    ]


@pytest.mark.skipif(not (ROOT / ".git").exists() or shutil.which("git") is None, reason="not a git checkout")
def test_no_text_holds_a_slot_still_to_be_filled() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-z", "*.md"], cwd=ROOT, capture_output=True, text=True, timeout=30, check=True
    )
    names = [name for name in listed.stdout.split("\0") if name]
    assert "README.md" in names
    slots = [
        f"{name}:{line}"
        for name in names
        if (ROOT / name).exists()
        for line in unfilled((ROOT / name).read_text(encoding="utf-8"))
    ]
    assert slots == []


def test_a_slot_is_a_template_or_a_cell_of_an_ellipsis_alone() -> None:
    assert unfilled("fine\n| level | … |\n") == ["2: | level | … |"]
    assert unfilled("as {{ figure }} says") == ["1: as {{ figure }} says"]
    assert unfilled("| `env.…` | and so on … |\n… | goes on") == []
