"""Files that are whole or not there, and lines that are whole or not written."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

from imagine.core.errors import WorkError

_FULL = (errno.ENOSPC, errno.EDQUOT)


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
        with contextlib.suppress(OSError):  # the folder may be why it failed
            temporary.unlink()


def append_whole(path: Path, data: bytes) -> None:
    """Append `data` to a file, all of it or nothing: what a full disk cuts short is taken back.

    Raises WorkError when the disk is full or the file cannot be written.
    """
    try:
        with path.open("ab", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            try:
                left = memoryview(data)
                while left:
                    left = left[file.write(left) :]
            except OSError:
                with contextlib.suppress(OSError):  # devices cannot be cut
                    file.truncate(end)
                raise
    except OSError as error:
        raise write_failure(path, error) from error


def write_failure(path: Path, error: OSError | RuntimeError) -> WorkError:
    """Return the error to raise when a file of a run cannot be written."""
    if isinstance(error, OSError) and error.errno not in _FULL:
        return WorkError(f"{path}: cannot be written: {error.strerror or error}")
    # torch's zip writer says only that its file is shorter than what it wrote
    if isinstance(error, OSError) or "writ" in str(error) or "unexpected pos" in str(error):
        return WorkError(f"{path}: cannot be written: the disk is full; free some space, then resume the run")
    return WorkError(f"{path}: cannot be written: {error}")
