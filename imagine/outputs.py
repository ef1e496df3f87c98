"""Files a command writes at its end: refused before hours of work where they cannot be written."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from imagine.core.errors import InputError


def check_outputs(
    json_file: Path | None, map_file: Path | None = None, film_file: Path | None = None, map_flag: str = "--map"
) -> None:
    """Raise InputError naming a file that cannot be written.

    `map_file`, given as `map_flag`, needs to be a PNG, `film_file` GIF or MP4.
    """
    if map_file is not None and map_file.suffix.lower() != ".png":
        raise InputError(f"{map_flag} {map_file}: what is drawn is a PNG: name a file that ends in .png")
    if film_file is not None:
        from imagine.sim.film import check_film

        check_film(film_file)
    for path in (json_file, map_file, film_file):
        if path is None:
            continue
        if path.is_dir():
            raise InputError(f"{path}: is a folder; name a file in it")
        if not path.absolute().parent.is_dir():
            raise InputError(f"{path}: its folder does not exist")
        if not os.access(path if path.exists() else path.absolute().parent, os.W_OK):
            raise InputError(f"{path}: cannot be written: no permission")


def write_json(path: Path | None, data: Any) -> None:
    """Write results where they are wanted. Raises InputError if the file cannot be written."""
    if path is None:
        return
    try:
        path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: the results cannot be written: {error.strerror}") from error
