"""Where a level comes from: the built-in ones, the generator, and each kind of file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from imagine.core.config import parse_yaml, read_yaml
from imagine.core.errors import InputError
from imagine.sim.floorplan import load_floorplan
from imagine.sim.generator import is_generated, level_by_seed
from imagine.sim.level import BUILT_IN, Level
from imagine.sim.level_file import read_level
from imagine.sim.map_image import IMAGE_SUFFIXES, load_image, load_map


def open_level(name: str) -> Level:
    """Return the level of this name, as `load_level` describes. Raises InputError."""
    if name in BUILT_IN:
        text = resources.files("imagine.sim").joinpath(f"levels/{name}.yaml").read_text(encoding="utf-8")
        return read_level(name, f"level {name}", *parse_yaml(text, f"level {name}"))
    if is_generated(name):
        return level_by_seed(name)
    file, at, _ = name.rpartition("@")
    if at and Path(file).suffix.lower() in IMAGE_SUFFIXES:
        return load_image(name)
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix in IMAGE_SUFFIXES:
        raise InputError(f"level {name}: an image has no scale: give metres a pixel behind it, such as {name}@0.05")
    if suffix not in (".yaml", ".yml", ".json") or not path.exists():
        raise InputError(
            f"unknown level '{name}': give one of {', '.join(BUILT_IN)}, house:SEED, or a file that exists: a level's "
            "YAML, a floor plan's JSON, or an image with its scale, plan.png@0.05"
        )
    if suffix == ".json":
        return load_floorplan(path)
    data, lines = read_yaml(path)
    if "image" in data:
        return load_map(path, data, lines)
    return read_level(path.stem, str(path), data, lines)
