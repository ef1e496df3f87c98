"""Settings: what is wrong is named with file, line, key and the nearest key that exists."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from imagine.core.config import Settings, apply_overrides, load_settings, parse_yaml
from imagine.core.errors import InputError


class Radio(Settings):
    range_m: float = Field(default=5.0, gt=0.0)
    loss: float = 0.0


class Swarm(Settings):
    drones: int = Field(default=3, ge=1)
    name: str = "swarm"
    radio: Radio = Radio()
    launch: tuple[float, float] | None = None
    radios: list[Radio] = Field(default_factory=list)


def write(folder: Path, text: str) -> Path:
    path = folder / "swarm.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(folder: Path, text: str, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_settings(Swarm, write(folder, text), overrides)
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.exit_status == 2
    return message.replace(str(folder) + "/", "")


def test_without_a_file_all_is_default() -> None:
    assert load_settings(Swarm, None) == Swarm()


def test_files_and_overrides_are_laid_over_each_other(tmp_path: Path) -> None:
    path = write(tmp_path, "drones: 5\nradio:\n  range_m: 7\n")
    settings = load_settings(Swarm, path, ["radio.loss=1e-2", "launch=[1, 2]", "name=a b"])
    assert settings == Swarm(drones=5, name="a b", radio=Radio(range_m=7.0, loss=0.01), launch=(1.0, 2.0))
    assert load_settings(Swarm, path, ["drones=1", "drones=2"]).drones == 2


def test_an_empty_file_is_all_default(tmp_path: Path) -> None:
    assert load_settings(Swarm, write(tmp_path, "# nothing yet\n")) == Swarm()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("drones: 2\ndrone: 3\n", "swarm.yaml:2: unknown key 'drone'; did you mean 'drones'?"),
        ("radio:\n  range: 3\n", "swarm.yaml:2: unknown key 'radio.range'; did you mean 'range_m'?"),
        ("radio:\n  zzz: 3\n", "swarm.yaml:2: unknown key 'radio.zzz'; valid keys: range_m, loss"),
        ("radios:\n  - loss: 0\n  - zzz: 3\n", "swarm.yaml:3: unknown key 'radios.1.zzz'"),
        ("name: x\ndrones: 0\n", "swarm.yaml:2: drones: Input should be greater than or equal to 1 (got 0)"),
        ("drones: many\n", "swarm.yaml:1: drones: Input should be a valid integer"),
        ("radio:\n  loss: .inf\n", "swarm.yaml:2: radio.loss: Input should be a finite number"),
        ("launch: [1]\n", "swarm.yaml:1"),
        ("radio: 5\n", "swarm.yaml:1: radio: "),
        ("- drones\n", "swarm.yaml:1: expected keys and values, found list"),
        ("drones: 3\n name: x\n", "swarm.yaml:2: not valid YAML: "),
        ("drones: [1\n", "swarm.yaml:2: not valid YAML: "),
        ("name: 2026-13-01\n", "swarm.yaml: not valid YAML: month must be in 1..12"),
        ("drones: !!int three\n", "swarm.yaml: not valid YAML: "),
        ("name: " + "[" * 1000, "swarm.yaml: not valid YAML: "),
        ("name: \x07\n", "swarm.yaml: not valid YAML: "),
        ("name: &a [*a]\n", "swarm.yaml:1: name: Input should be a valid string"),
        ("name: !!python/object/apply:os.getcwd []\n", "swarm.yaml:1: not valid YAML: "),
        ("3: x\n", "swarm.yaml: 3: Keys should be strings"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(tmp_path: Path, text: str, said: str) -> None:
    assert refusal(tmp_path, text).startswith(said)


def test_an_alias_that_stands_for_much_costs_little(tmp_path: Path) -> None:
    """Each of thirty lines doubles the one before; walked as a tree that would be a thousand million nodes."""
    doubling = "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 31))
    assert "unknown key 'a0'" in refusal(tmp_path, "a0: &a0 [1]\n" + doubling)
    nested = doubling.replace("a", "  a").replace("&  a", "&a").replace("*  a", "*a")
    assert refusal(tmp_path, "drones:\n  a0: &a0 [1]\n" + nested).startswith("swarm.yaml:1: drones: Input should be")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("drones", "--set drones: expected key=value"),
        ("=3", "--set =3: expected key=value"),
        ("drones=[1", "--set drones=[1: the value is not valid YAML"),
        ("name=2026-13-01", "--set name=2026-13-01: the value is not valid YAML"),
        ("dornes=3", "swarm.yaml: unknown key 'dornes'; did you mean 'drones'?"),
        ("radio.loss.x=3", "swarm.yaml"),
        ("drones=x", "swarm.yaml"),
    ],
)
def test_wrong_overrides_are_named(tmp_path: Path, override: str, said: str) -> None:
    assert refusal(tmp_path, "name: x\n", override).startswith(said)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.yaml: cannot be read: No such file"):
        load_settings(Swarm, tmp_path / "absent.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        load_settings(Swarm, tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"name: caf\xe9\n")
    with pytest.raises(InputError, match="not UTF-8"):
        load_settings(Swarm, tmp_path / "latin.yaml")


def test_overrides_leave_what_they_are_laid_over_untouched() -> None:
    data = {"radio": {"loss": 0.5}}
    assert apply_overrides(data, ["radio.range_m=3"]) == {"radio": {"loss": 0.5, "range_m": 3}}
    assert data == {"radio": {"loss": 0.5}}


def test_every_key_has_its_line() -> None:
    _, lines = parse_yaml("a: 1\nb:\n  c: 2\n  d:\n    - 3\n    - e: 4\n", "here")
    assert lines == {("a",): 1, ("b",): 2, ("b", "c"): 3, ("b", "d"): 4, ("b", "d", 0): 5, ("b", "d", 1): 6,
                     ("b", "d", 1, "e"): 6}  # fmt: skip


@given(st.text(max_size=30))
def test_whatever_the_text_it_is_read_or_refused(text: str) -> None:
    try:
        data, lines = parse_yaml(text, "here")
    except InputError:
        return
    assert isinstance(data, dict)
    assert all(line >= 1 for line in lines.values())


def test_a_key_given_twice_is_refused_with_both_lines() -> None:
    with pytest.raises(InputError, match=r"^room\.yaml:3: key 'a\.b' stands in line 2 already$"):
        parse_yaml("a:\n  b: 1\n  b: 2\n", "room.yaml")


class Link(Settings):
    protocol: Literal["off", "one-hop"] = "one-hop"
    sealed: bool = True


def test_a_bare_off_is_the_word_where_that_is_a_choice(tmp_path: Path) -> None:
    """YAML reads it as false, and `--set protocol=off` would be refused."""
    assert load_settings(Link, write(tmp_path, "protocol: off\nsealed: off\n")) == Link(protocol="off", sealed=False)
    assert load_settings(Link, None, ("protocol=off",)).protocol == "off"
