"""Compiled kernels are never older than the sources they come from."""

from __future__ import annotations

from pathlib import Path

import pytest

from imagine.kernel_cache import kernel_digest

SOURCES = {
    "core/raster.py": "CELL = 0.1",  # no kernel of its own, but kernels take the constant
    "sim/twin.py": "TICK_S = 0.1",
    "gcs/draw.py": "@numba.njit\ndef draw(): ...",
    "gcs/page.py": "TITLE = 'IMAGINE'",
    "train/baselines/paths.py": "@numba.njit\ndef follow(): ...",
}


@pytest.mark.parametrize(
    ("changed", "is_new"),
    [
        ("core/raster.py", True),
        ("sim/twin.py", True),
        ("gcs/draw.py", True),
        ("gcs/page.py", False),
        ("train/baselines/paths.py", True),
    ],
)
def test_a_change_of_what_kernels_are_made_of_changes_their_folder(changed: str, is_new: bool, tmp_path: Path) -> None:
    for name, text in SOURCES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    before = kernel_digest(tmp_path)
    assert kernel_digest(tmp_path) == before
    (tmp_path / changed).write_text(SOURCES[changed] + "  # and more")
    assert (kernel_digest(tmp_path) != before) == is_new
