"""What `imagine level` shows and writes: the levels there are, a level's figures and picture, generated houses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from imagine.core.errors import InputError
from imagine.core.raster import CELL
from imagine.outputs import write_json
from imagine.sim.generator import generate_file
from imagine.sim.level import BUILT_IN, Level, load_level
from imagine.sim.level_check import MOST_DRONES, narrowest_passage_m, room_for
from imagine.sim.level_file import level_text
from imagine.sim.level_image import draw_level

_HOW_ELSE = (
    "also: house:SEED or house:SEED:AREA, generated; a level's YAML; a floor plan's JSON; an image, plan.png@0.05"
)


def list_levels(json_file: Path | None) -> None:
    """Print the built-in levels, and how others are named."""
    found = [measures(load_level(name)) for name in BUILT_IN]
    table = Table("level", "title", "size, m", "free, m²", box=None)
    for one in found:
        table.add_row(one["level"], one["title"], _size(one), f"{one['free_m2']:.0f}")
    console = Console()
    console.print(table)
    console.print(_HOW_ELSE, highlight=False, soft_wrap=True)
    write_json(json_file, found)


def show_level(name: str, image: Path | None, json_file: Path | None) -> None:
    """Print a level's figures, and draw it where a picture is wanted."""
    level = load_level(name)
    found = measures(level)
    table = Table(show_header=False, title=f"level {level.name}", title_justify="left")
    for label, value in (
        ("title", level.title),
        ("size", f"{_size(found)} m"),
        ("launch", f"({level.launch[0]:g}, {level.launch[1]:g})"),
        ("free", f"{found['free_m2']:.1f} m²"),
        ("to be covered", f"{found['coverable_cells']} cells of 0.1 m"),
        ("flyable", f"{found['flyable_share']:.0%} of the free cells"),
        ("drones it can launch", _room(found)),
        ("narrowest passage", _passage(found)),
        ("edges and posts", f"{found['edges']} and {found['posts']}"),
        ("people, crates", f"{found['people']}, {found['crates']}"),
        ("fingerprint", found["fingerprint"][:16]),
    ):
        table.add_row(label, value)
    Console().print(table)
    _draw(level, image)
    write_json(json_file, found)


def check_levels(names: list[str], json_file: Path | None) -> None:
    """Print each level's figures, or why it cannot be explored. Raises InputError if there are any of these."""
    figures = ("size, m", "free, m²", "to cover, cells", "flyable", "drones", "passage")
    name_column = Column("level", overflow="fold")  # cut off, long paths in one folder would read the same
    table = Table(name_column, *figures, box=None)
    rows: list[dict[str, Any]] = []
    refused: list[str] = []
    console = Console()
    for name in names:
        try:
            found = measures(load_level(name))
        except InputError as error:
            refused.append(str(error))
            rows.append({"level": name, "error": str(error)})
            continue
        rows.append(found)
        table.add_row(
            name, _size(found), f"{found['free_m2']:.1f}", str(found["coverable_cells"]),
            f"{found['flyable_share']:.0%}", _room(found), _passage(found),
        )  # fmt: skip
    if table.rows:
        console.print(table)
    for reason in refused if len(names) > 1 else ():
        console.print(f"refused: {reason}", highlight=False, soft_wrap=True)
    write_json(json_file, rows)
    if refused:
        count = f"{len(refused)} of {len(names)} levels cannot be explored, the first: " if len(names) > 1 else ""
        raise InputError(count + refused[0])


def generate_levels(
    seed: int, area_m2: float | None, count: int, people: int, crates: int, out: Path | None, image: Path | None,
    json_file: Path | None,
) -> None:  # fmt: skip
    """Write generated houses as YAML: one to a file or standard output, several to a folder, one picture."""
    if count > 1 and (out is None or out.suffix in (".yaml", ".yml")):
        raise InputError(f"level generate: {count} levels need a folder: -o FOLDER")
    if count > 1 and image is not None:
        raise InputError(f"level generate: --image draws one level, not {count}; use imagine level show")
    rows = []
    for number in range(seed, seed + count):
        text = level_text(generate_file(number, area_m2, people, crates))
        path = _write(out, number, count, text)
        if path is None:
            print(text, end="")
            level = None
        else:
            level = load_level(str(path))
            print(f"{path}: {level.title}, {level.coverable.sum() * CELL * CELL:.0f} m² to cover")
        if level is None and (image is not None or json_file is not None):
            level = _read_back(text, number)
        if level is not None:
            _draw(level, image, quiet=path is None)
            rows.append(measures(level) | {"seed": number, "file": None if path is None else str(path)})
    write_json(json_file, rows)


def _read_back(text: str, seed: int) -> Level:
    from imagine.core.config import parse_yaml
    from imagine.sim.level_file import read_level

    return read_level(f"house-{seed}", f"house {seed}", *parse_yaml(text, f"house {seed}"))


def _write(out: Path | None, seed: int, count: int, text: str) -> Path | None:
    """Write a level's YAML where it is wanted; a folder is made where there is none. Returns the file's path."""
    if out is None:
        return None
    path = out if count == 1 and out.suffix in (".yaml", ".yml") else out / f"house-{seed}.yaml"
    try:
        if path != out:
            out.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: the level cannot be written: {error.strerror}") from error
    return path


def measures(level: Level) -> dict[str, Any]:
    """Return a level's figures, as `--json` writes them: metres, square metres, cells of 0.1 m."""
    width, depth = level.outline.max(axis=0) - level.outline.min(axis=0)
    free = int(level.free.sum())
    passage = narrowest_passage_m(level)
    return {
        "level": level.name,
        "title": level.title,
        "width_m": round(float(width), 3),
        "depth_m": round(float(depth), 3),
        "launch": [float(c) for c in level.launch],
        "free_m2": round(free * CELL * CELL, 2),
        "coverable_cells": int(level.coverable.sum()),
        "unseen_cells": int(np.count_nonzero(level.free & ~level.survey.seen)),
        "flyable_share": round(float(level.flyable.sum() / free), 4),
        "room_for_drones": room_for(level),
        "narrowest_passage_m": None if passage is None else round(passage, 2),
        "edges": len(level.segments),
        "posts": len(level.circles),
        "people": len(level.people),
        "crates": len(level.crates),
        "fingerprint": level.fingerprint(),
    }


def _draw(level: Level, image: Path | None, quiet: bool = False) -> None:
    if image is None:
        return
    try:
        draw_level(level).save(image)
    except (OSError, ValueError) as error:
        raise InputError(f"{image}: the picture cannot be written: {error}") from error
    if not quiet:
        print(f"{image}: drawn")


def _size(found: dict[str, Any]) -> str:
    return f"{found['width_m']:g} × {found['depth_m']:g}"


def _room(found: dict[str, Any]) -> str:
    room = found["room_for_drones"]
    return f"{room} or more" if room >= MOST_DRONES else str(room)


def _passage(found: dict[str, Any]) -> str:
    passage = found["narrowest_passage_m"]
    return "above 1 m" if passage is None else f"{passage:.2f} m"
