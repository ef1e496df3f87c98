"""What the texts tell people to type is what the command line takes."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer
from command_line import POLICY, run_imagine

from imagine.cli import app
from imagine.core.config import load_settings
from imagine.onboard.settings import DroneSettings

ROOT = Path(__file__).resolve().parents[2]
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SYNOPSIS = re.compile(r"[\[\]|…]")
USAGE_ERROR: Any = typer.BadParameter.__mro__[1]  # click's, or that of typer's own copy


def commands_in_fences(text: str) -> list[str]:
    """Return the command lines that a text's code fences hold, one a command, without comments."""
    found = []
    for _, block in FENCE.findall(text):
        joined = re.sub(r"\\\n\s*", " ", block)
        joined = re.sub(r"\n {8,}(?=\[)", " ", joined)  # a synopsis goes on, indented
        for line in joined.splitlines():
            parts = re.sub(r"\s#\s.*$", "", line).split(" && ")
            found += [part.strip() for part in parts if re.match(r"(imagine|make|python -m imagine)\b", part.strip())]
    return found


def commands_in_prose(text: str) -> list[str]:
    """Return what stands in single backticks and begins with the command's name; mesh.md's labels of keys do too."""
    return re.findall(r"`((?:imagine|python -m imagine[\w.]*) (?!key |sender |ground`)[^`\n]+)`", FENCE.sub("", text))


def resolve(words: list[str]) -> tuple[Any, list[str]]:
    """Return the command that `words`, after `imagine`, name, and what is left of them. Raises KeyError on none."""
    command: Any = typer.main.get_command(app)
    rest = list(words)
    while hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        command = command.commands[rest.pop(0)]
    return command, rest


def complaint(line: str, strict: bool) -> str:
    """Return what the command line would say against a documented line, empty where it takes it.

    Not strict (synopses, and commands named in prose): its words and options must exist, values are not looked at.
    """
    words = shlex.split(line) if strict else re.findall(r"[^\s\[\]|]+", line)
    if words[:2] == ["python", "-m"]:
        return "" if importlib.util.find_spec(words[2]) else f"no module {words[2]}"
    if words[0] == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        wrong = [word for word in words[1:] if "=" not in word and word not in targets]
        return f"no target {wrong}" if wrong else ""
    try:
        command, rest = resolve(words[1:])
    except KeyError as error:
        return f"no command {error}"
    if strict:
        try:
            command.make_context(words[-1], rest)
        except USAGE_ERROR as error:
            return str(error.format_message())
        return ""
    known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    wrong = [word for word in rest if re.match(r"-{1,2}[a-z]", word) and word.split("=")[0] not in known | {"--help"}]
    return f"no option {wrong}" if wrong else ""


@pytest.mark.parametrize("path", TEXTS, ids=[path.name for path in TEXTS])
def test_every_documented_command_is_one_that_the_command_line_takes(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    fenced = [(line, SYNOPSIS.search(line) is None or "'" in line) for line in commands_in_fences(text)]
    wrong = [
        f"{line}: {why}"
        for line, strict in [*fenced, *((line, False) for line in commands_in_prose(text))]
        if (why := complaint(line, strict))
    ]
    assert wrong == []


def test_the_texts_hold_commands_to_look_at() -> None:
    texts = {path.name: path.read_text(encoding="utf-8") for path in TEXTS}
    assert len(commands_in_fences(texts["README.md"])) >= 7
    assert any("launch.y=1.45" in line for line in commands_in_fences(texts["flying.md"]))  # a line that goes on
    assert sum(len(commands_in_fences(text)) for text in texts.values()) > 30


@pytest.mark.parametrize(
    ("line", "strict"),
    [
        ("imagine fly --sim --no-such-thing", True),
        ("imagine fly --sim --drones many", True),
        ("imagine flee --sim", True),
        ("imagine fly --sim [--gravity 9.81]", False),
        ("imagine level inspect", False),
        ("make coffee", True),
        ("python -m imagine.nowhere", True),
    ],
)
def test_a_command_that_does_not_exist_is_found(line: str, strict: bool) -> None:
    assert complaint(line, strict) != ""


def test_the_drone_settings_of_the_flying_page_are_settings(tmp_path: Path) -> None:
    blocks = [block for kind, block in FENCE.findall((ROOT / "docs/flying.md").read_text(encoding="utf-8"))
              if kind == "yaml"]  # fmt: skip
    assert blocks
    for number, block in enumerate(blocks):
        file = tmp_path / f"{number}.yaml"
        file.write_text(block, encoding="utf-8")
        assert load_settings(DroneSettings, file, []).drone_id == 1


@pytest.mark.sitl
def test_the_readmes_flight_flies_and_leaves_its_files(tmp_path: Path) -> None:
    (line,) = [c for c in commands_in_fences(TEXTS[0].read_text(encoding="utf-8")) if "--json flight.json" in c]
    done = run_imagine(*shlex.split(line)[1:], "--ticks", "40", *POLICY, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "flight.json").exists()
    assert (tmp_path / "flight.png").exists()
