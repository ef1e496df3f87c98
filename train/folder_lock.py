"""One process at a time in a folder of a run or a study."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from imagine.core.errors import InputError

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def locked(folder: Path, busy: str) -> Iterator[None]:
    """Keep other processes out of a folder, which is made where it is missing.

    `busy` says what whoever holds it does there, and what can be done. The lock is the kernel's, on the file `.lock`:
    however a process ends, its lock ends with it. The file stays, for whoever removed it could remove another's. Raises
    InputError naming the folder and the process that holds it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("a+")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    with lock as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            holder = file.read().strip()
            by = f"process {holder}" if holder else "another process"
            raise InputError(f"{folder}: {by} {busy}") from error
        except OSError as error:  # some network disks know no locks
            logger.warning("%s: cannot be locked (%s): start nothing else in it", folder, error.strerror)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")  # appended, after what a process that died left was cut away
        file.flush()
        yield
