"""Settings from YAML files and `--set key=value` overrides, checked by pydantic, with errors that name key and line."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from imagine.core.errors import InputError


class Settings(BaseModel):
    """Base of all settings: immutable, unknown keys refused, no silent conversion of text to numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _off_in_yaml(cls, data: Any) -> Any:
        """Take a bare off, which YAML 1.1 reads as false, as the word where that is a choice."""
        if not isinstance(data, dict):
            return data
        words = {name for name, field in cls.model_fields.items() if "off" in get_args(field.annotation)}
        return {key: "off" if value is False and key in words else value for key, value in data.items()}


S = TypeVar("S", bound=BaseModel)
KeyPath = tuple[str | int, ...]

_SHORT = reprlib.Repr()  # stops early: a few lines of YAML with aliases can stand for millions of values
_SHORT.maxstring = _SHORT.maxother = 80


def load_settings(model: type[S], path: Path | None, overrides: Sequence[str] = ()) -> S:
    """Read a settings file (None: all defaults), apply `key.sub=value` overrides, and check the result.

    Raises InputError with file, line, key and the nearest valid key.
    """
    data, lines = ({}, {}) if path is None else read_yaml(path)
    data = apply_overrides(data, overrides)
    return check_settings(model, data, where=str(path) if path else "settings", lines=lines)


def read_yaml(path: Path) -> tuple[dict[str, Any], dict[KeyPath, int]]:
    """Read a YAML mapping; return it with the line of every key. Raises InputError naming file and line."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise InputError(f"{path}: cannot be read: {reason}") from error
    return parse_yaml(text, str(path))


def parse_yaml(text: str, where: str) -> tuple[dict[str, Any], dict[KeyPath, int]]:
    """Parse YAML text as `read_yaml` does; `where` names it in errors."""
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        raise InputError(f"{where}{line}: not valid YAML: {problem}") from error
    except (ValueError, RecursionError) as error:  # such as the date 2026-13-01, or a thousand brackets
        raise InputError(f"{where}: not valid YAML: {error}") from error
    if data is None:
        return {}, {}
    if not isinstance(data, dict):
        raise InputError(f"{where}:1: expected keys and values, found {type(data).__name__}")
    lines: dict[KeyPath, int] = {}
    try:
        _collect_lines(node, (), lines, set())
    except _RepeatedKey as error:
        raise InputError(f"{where}:{error}") from error
    return data, lines


class _RepeatedKey(ValueError):
    """A key given twice: YAML would silently keep the last."""


def _collect_lines(node: yaml.Node | None, at: KeyPath, lines: dict[KeyPath, int], visited: set[int]) -> None:
    if id(node) in visited:
        return  # an alias: what it stands for is noted where it was written, and may hold the alias itself
    visited.add(id(node))
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if (*at, key.value) in lines:
                first, again = lines[(*at, key.value)], key.start_mark.line + 1
                name = ".".join(map(str, (*at, key.value)))
                raise _RepeatedKey(f"{again}: key '{name}' stands in line {first} already")
            lines[(*at, key.value)] = key.start_mark.line + 1
            _collect_lines(value, (*at, key.value), lines, visited)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            lines[(*at, index)] = value.start_mark.line + 1
            _collect_lines(value, (*at, index), lines, visited)


def apply_overrides(data: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return `data` with `key.sub=value` overrides laid over it; values are read as YAML."""
    merged = dict(data)
    for override in overrides:
        key, equals, raw = override.partition("=")
        if not equals or not key.strip():
            raise InputError(f"--set {override}: expected key=value, for example --set ppo.lr=1e-4")
        try:
            value = yaml.safe_load(raw)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise InputError(f"--set {override:.80}: the value is not valid YAML") from error
        if isinstance(value, str):
            value = _number(value)
        target = merged
        parts = key.strip().split(".")
        for part in parts[:-1]:
            child = target.get(part)
            target[part] = dict(child) if isinstance(child, dict) else {}
            target = target[part]
        target[parts[-1]] = value
    return merged


def _number(text: str) -> Any:
    """Read 1e-4, which YAML 1.1 takes for text, as the number it is."""
    try:
        return float(text)
    except ValueError:
        return text


def check_settings(model: type[S], data: dict[str, Any], where: str, lines: dict[KeyPath, int] | None = None) -> S:
    """Check a mapping against a settings model. Raises InputError naming place, line, key and remedy."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        location: KeyPath = tuple(first["loc"])
        line = _line_of(location, lines or {})
        key = ".".join(map(str, location))
        place = f"{where}:{line}" if line else where
        if first["type"] == "extra_forbidden":
            raise InputError(f"{place}: unknown key '{key}'{_nearest(model, location)}") from error
        if first["type"] == "missing":
            raise InputError(f"{place}: key '{key}' is missing") from error
        got = first.get("input")
        message = first["msg"].removeprefix("Value error, ")
        if not key:  # a rule about several keys at once
            raise InputError(f"{place}: {message}" if data else f"{where}: it is empty: {message}") from error
        raise InputError(f"{place}: {key}: {message} (got {_SHORT.repr(got):.80})") from error


def _line_of(location: KeyPath, lines: dict[KeyPath, int]) -> int | None:
    for end in range(len(location), 0, -1):
        if location[:end] in lines:
            return lines[location[:end]]
    return None


def _nearest(model: type[BaseModel], location: KeyPath) -> str:
    """Suggest the nearest valid key beside an unknown one, or list them all."""
    parent: Any = model
    for part in location[:-1]:
        info = parent.model_fields.get(part) if isinstance(part, str) and hasattr(parent, "model_fields") else None
        parent = info.annotation if info is not None else None
        if not (isinstance(parent, type) and issubclass(parent, BaseModel)):
            return ""
    names = list(parent.model_fields)
    close = difflib.get_close_matches(str(location[-1]), names, n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else f"; valid keys: {', '.join(names)}"
