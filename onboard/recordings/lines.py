"""Reading a recording's lines, plain or gzip, with errors that name file and line."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError

_GZIP_MAGIC = b"\x1f\x8b"


class Line(NamedTuple):
    """A line of text, its place `file:line` for errors, and whether its end was in the file."""

    text: str
    where: str
    complete: bool


def read_lines(path: Path) -> Iterator[Line]:
    """Yield the lines of a text file, unpacked if it is gzip.

    Raises InputError, naming the line reached, where the file cannot be read, is cut short, or is not text.
    """
    number = 0
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == _GZIP_MAGIC
        with gzip.open(path, "rb") if packed else path.open("rb") as file:
            for number, line in enumerate(file, start=1):
                yield Line(line.decode("utf-8").rstrip("\r\n"), f"{path}:{number}", line.endswith(b"\n"))
    except EOFError as error:
        raise InputError(f"{path}:{number + 1}: the gzip file is cut short here; get it whole again") from error
    except (zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}:{number + 1}: the gzip file is damaged here: {error}; get it again") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}:{number}: not text, so not a recording or a damaged one") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def numbers(tokens: Sequence[str], line: Line) -> NDArray[np.float64]:
    """Read tokens as finite numbers. Raises InputError naming the line and the token that is none."""
    try:
        values = np.array(tokens, dtype=np.float64)
    except ValueError:
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        raise InputError(f"{line.where}: {_first_bad(tokens)!r:.40} is not a finite number")
    return values


def _first_bad(tokens: Sequence[str]) -> str:
    for token in tokens:
        try:
            if not np.isfinite(float(token)):
                return token
        except ValueError:
            return token
    return ""


def require_whole(line: Line) -> None:
    """Raise InputError where a scan's line breaks off at the end of the file: its last number may be half a number."""
    if not line.complete:
        raise InputError(f"{line.where}: the file is cut short within this line; remove the line or get it whole again")
