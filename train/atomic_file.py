"""Files that are whole or not there: written beside their place, then moved into it."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

from imagine.core.errors import WorkError


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then put it in place; an older file stays until then.

    Raises WorkError when the disk is full or the folder cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except (OSError, RuntimeError) as error:  # torch reports a full disk as a RuntimeError of its zip writer
        raise write_failure(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_failure(path: Path, error: OSError | RuntimeError) -> WorkError:
    """Return the error to raise when a file of a run cannot be written."""
    if isinstance(error, OSError) and error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return WorkError(f"{path}: cannot be written: {error.strerror or error}")
    if isinstance(error, OSError) or "writ" in str(error):
        return WorkError(f"{path}: cannot be written: the disk is full; free some space, then resume the run")
    return WorkError(f"{path}: cannot be written: {error}")
