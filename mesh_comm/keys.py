"""The swarm's key and the boot number: the two small files that sealing rests on."""

from __future__ import annotations

import logging
import os
import secrets
from collections.abc import Mapping
from pathlib import Path

from imagine.core.errors import InputError
from imagine.mesh_comm.seal import KEY_BYTES

KEY_VARIABLE = "IMAGINE_MESH_KEY"
_EPOCH_S = 1_577_836_800  # 2020-01-01: leaves a u32 boot number room until 2156
_log = logging.getLogger(__name__)


def write_new_key(path: Path) -> bytes:
    """Create a key file (64 hexadecimal digits, mode 0600) and return the key.

    Raises InputError if the file exists, so that a swarm's key is never lost by accident, or cannot be written.
    """
    key = secrets.token_bytes(KEY_BYTES)
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise InputError(f"{path}: exists already; choose another name, or remove it first") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(key.hex() + "\n")
    return key


def load_key(path: Path) -> bytes:
    """Read a key file. Raises InputError if it is unreadable or does not hold a 32-byte key in hexadecimal."""
    try:
        text = path.read_text(encoding="ascii")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a key file of 64 hexadecimal digits") from error
    except OSError as error:
        raise InputError(f"{path}: the mesh key cannot be read: {error.strerror}") from error
    key = parse_key(text, str(path))
    if path.stat().st_mode & 0o077:
        _log.warning("%s: others on this machine can read the mesh key; chmod 600 it", path)
    return key


def parse_key(text: str, where: str) -> bytes:
    """Read a key from 64 hexadecimal digits; `where` names their origin in the InputError."""
    try:
        key = bytes.fromhex(text.strip())
    except ValueError as error:
        raise InputError(f"{where}: the mesh key is not hexadecimal; make one with `imagine keygen`") from error
    if len(key) != KEY_BYTES:
        raise InputError(f"{where}: the mesh key has {2 * len(key)} hexadecimal digits, needs {2 * KEY_BYTES}")
    return key


def find_key(path: Path | None, environ: Mapping[str, str]) -> bytes:
    """Return the key of the file, or else of the variable IMAGINE_MESH_KEY. Raises InputError if there is neither."""
    if path is not None:
        return load_key(path)
    if text := environ.get(KEY_VARIABLE):
        return parse_key(text, KEY_VARIABLE)
    raise InputError(f"no mesh key: name a key file or set {KEY_VARIABLE}; make one with `imagine keygen`")


def default_boot_file(node: int) -> Path:
    """Return where drone `node` remembers its boot number unless told otherwise."""
    return Path(f"~/.imagine/drone-{node}.boot")


def next_boot_number(path: Path, unix_time_s: float) -> int:
    """Return a number greater than at any earlier start, and remember it in the file `path`.

    The clock (seconds since 2020) keeps numbers growing when the file is lost, the file when the clock is wrong. A
    leading `~` is the home folder; the file's folder is made if need be. Raises InputError if the file is damaged or
    cannot be written, since a repeated number would break the seal.
    """
    last = 0
    try:
        path = path.expanduser()
    except RuntimeError as error:
        raise InputError(f"{path}: no such home folder; set boot_file to a file that can be written") from error
    try:
        last = int(path.read_text(encoding="ascii")) if path.exists() else 0
    except ValueError as error:
        raise InputError(f"{path}: does not hold a boot number; remove it if the clock is right") from error
    except OSError as error:
        raise InputError(f"{path}: the boot number cannot be read: {error.strerror}") from error
    boot = max(last + 1, int(unix_time_s) - _EPOCH_S)
    fresh = path.with_name(path.name + ".new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with fresh.open("w", encoding="ascii") as file:
            file.write(f"{boot}\n")
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except OSError as error:
        raise InputError(
            f"{path}: the boot number cannot be written: {error.strerror}; set boot_file to a file that can be"
        ) from error
    return boot
