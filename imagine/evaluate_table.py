"""The table that `imagine evaluate` shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

Row = dict[str, Any]
_WIDEST_NAME = 16


def table_of(rows: Sequence[Row], title: str) -> Table:
    """Return a table that fits into 80 columns: policies beside each other on each level, `all` levels last.

    What is the same in all rows is left to the title. With one policy the columns tell all about it; with several, how
    they compare.
    """
    table = Table(title=escape(title), box=None, padding=(0, 1, 0, 0))
    compared = len({row["policy"] for row in rows}) > 1
    columns = _varying(rows) | (_COMPARED if compared else _ALONE)
    for heading in columns:
        table.add_column(heading, justify="left" if heading == "policy" else "right")
    before: list[str] = []
    for row in sorted(rows, key=_order(rows)):
        cells = [cell(row) for cell in columns.values()]
        place = [row["protocol"], row["drones"], row["level"]]
        if compared and before and place != before:
            table.add_row()
        before = place
        table.add_row(*map(escape, cells))
    return table


def title_of(rows: Sequence[Row], launch: str, overrides: Sequence[str]) -> str:
    """Return what is the same in all rows, in words, with what `--set` changed."""
    same = []
    for key, words in (("policy", "{}"), ("drones", "{} drones"), ("protocol", "{}")):
        values = {row[key] for row in rows}
        if len(values) == 1:
            same.append(words.format(*values).replace("1 drones", "1 drone"))
    each = next((row["episodes"] for row in rows if row["level"] != "all"), 0)
    same.append(f"{each} episodes each")
    same += ["random launches"] if launch == "random" else []
    return ", ".join([*same, *overrides])


def short_level(name: str) -> str:
    """Return a level's name as tables and plots show it: files without their folder and suffix, long ones cut."""
    short = Path(name).stem if "/" in name or name.endswith((".json", ".yaml", ".yml")) else name
    return short if len(short) <= _WIDEST_NAME else short[: _WIDEST_NAME - 6] + ".." + short[-4:]


def _order(rows: Sequence[Row]) -> Callable[[Row], tuple[int, ...]]:
    """Order by protocol, team, level, then policy, each as it first came; rows come policy by policy."""
    firsts = [list(dict.fromkeys(row[key] for row in rows)) for key in ("protocol", "drones", "level", "policy")]
    for level in firsts[2]:
        if level == "all":
            firsts[2].remove(level)
            firsts[2].append(level)
            break
    keys = ("protocol", "drones", "level", "policy")
    return lambda row: tuple(first.index(row[key]) for first, key in zip(firsts, keys, strict=True))


def _varying(rows: Sequence[Row]) -> dict[str, Callable[[Row], str]]:
    shown: dict[str, Callable[[Row], str]] = {}
    if len({row["protocol"] for row in rows}) > 1:
        shown["radio"] = lambda row: str(row["protocol"])
    if len({row["drones"] for row in rows}) > 1:
        shown["n"] = lambda row: str(row["drones"])
    shown["level"] = lambda row: short_level(row["level"])
    if len({row["policy"] for row in rows}) > 1:
        shown["policy"] = lambda row: str(row["policy"])[-_WIDEST_NAME:]
    return shown


def _number(key: str) -> Callable[[Row], str]:
    return lambda row: _figures(row[key])


def _share(key: str) -> Callable[[Row], str]:
    return lambda row: f"{row[key]:.3f}"


def _figures(value: float) -> str:
    """Return a number with three figures, thousands in full."""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _interval(key: str) -> Callable[[Row], str]:
    return lambda row: "{:.0f}–{:.0f}".format(*row[key])


def _ratio(row: Row) -> str:
    return "" if row["paired"] is None else f"{row['paired']['t90_ratio']:.2f}"


def _ratio_interval(row: Row) -> str:
    return "" if row["paired"] is None else "{:.2f}–{:.2f}".format(*row["paired"]["t90_ratio_ci95"])


_ALONE: dict[str, Callable[[Row], str]] = {
    "seen": _share("coverage_mean"), "worst": _share("coverage_min"), "T90": _number("t90_mean"),
    "95 %": _interval("t90_ci95"), "reached": _number("t90_reached"), "T95": _number("t95_mean"),
    "contacts\na drone": _number("collisions_per_drone"), "path,\nm": _number("path_m"),
    "bytes\na drone": _number("bytes_per_drone"), "linked": _number("link_share"),
    "most /\nleast": _number("productivity_ratio"),
}  # fmt: skip
_COMPARED: dict[str, Callable[[Row], str]] = {
    "seen": _share("coverage_mean"), "worst": _share("coverage_min"), "T90": _number("t90_mean"),
    "95 %": _interval("t90_ci95"), "ratio": _ratio, "of 95 %": _ratio_interval,
    "contacts\na drone": _number("collisions_per_drone"),
}  # fmt: skip
