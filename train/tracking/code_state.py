"""Which code a run was made with: commit, branch, and what differs from the commit."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

logger = logging.getLogger(__name__)

MOST_PATCH_BYTES = 1_000_000
_SOURCES = ("*.py", "*.yaml", "*.yml", "*.toml", "constraints.txt")
_HERE = Path(__file__).resolve()


@dataclass(frozen=True)
class CodeState:
    """The checkout that runs. `patch` turns the commit into it, b"" where nothing differs; None where it is too long.

    Files that git does not know yet are in the patch too, if they are sources or settings.
    """

    commit: str
    branch: str
    patch: bytes | None

    @property
    def dirty(self) -> bool:
        """Whether the code differs from the commit."""
        return self.patch != b""


@cache
def own_code_state() -> CodeState | None:
    """Return the state of the checkout this package runs from, as first asked: what is edited later does not run."""
    return code_state(_HERE)


def code_state(file: Path) -> CodeState | None:
    """Return the state of the checkout that `file` belongs to; None where it is in none, as of an installed package."""
    try:
        root = Path(_git(file.parent, "rev-parse", "--show-toplevel").decode().strip())
        _git(root, "ls-files", "--error-unmatch", str(file))  # else it merely lies in somebody's checkout
        commit = _git(root, "rev-parse", "HEAD").decode().strip()
        branch = _git(root, "rev-parse", "--abbrev-ref", "HEAD").decode().strip()
        patch: bytes | None = _difference(root)
    except (OSError, subprocess.SubprocessError):
        return None
    if patch is not None and len(patch) > MOST_PATCH_BYTES:
        logger.warning("the code differs from commit %s by %.1f MB: too much to keep", commit[:10], len(patch) / 1e6)
        patch = None
    return CodeState(commit, branch, patch)


def _difference(root: Path) -> bytes:
    """Return the difference between HEAD and the working tree, in a copy of the index, so that git's own stays."""
    with tempfile.TemporaryDirectory() as folder:
        index = Path(folder) / "index"
        own = root / _git(root, "rev-parse", "--git-path", "index").decode().strip()
        if own.exists():
            shutil.copyfile(own, index)
        unknown = _git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", *_SOURCES).split(b"\0")
        if paths := [os.fsdecode(path) for path in unknown if path]:
            _git(root, "add", "--intent-to-add", "--", *paths, index=index)
        return _git(root, "diff", "--binary", "--no-color", "--no-ext-diff", "HEAD", index=index)


def _git(where: Path, *arguments: str, index: Path | None = None) -> bytes:
    environment = os.environ | ({"GIT_INDEX_FILE": str(index)} if index else {})
    command = ["git", *arguments]
    return subprocess.run(command, cwd=where, capture_output=True, timeout=10, check=True, env=environment).stdout
