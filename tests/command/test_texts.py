"""The project's texts are finished."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(not (ROOT / ".git").exists() or shutil.which("git") is None, reason="not a git checkout")
def test_no_text_holds_a_slot_still_to_be_filled() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-z", "*.md"], cwd=ROOT, capture_output=True, text=True, timeout=30, check=True
    )
    names = [name for name in listed.stdout.split("\0") if name]
    assert "README.md" in names
    unfilled = [
        f"{name}:{number}: {line.strip()}"
        for name in names
        if (ROOT / name).exists()
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), start=1)
        if "{{" in line
    ]
    assert unfilled == []
