"""The files that sealing rests on: the swarm's keys, and the boot number."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Mapping
from pathlib import Path

from imagine.core.errors import InputError
from imagine.mesh_comm.keyring import KEY_BYTES, KeyRing, format_ring, ground_public, parse_ring
from imagine.mesh_comm.seal import Sealer

KEY_VARIABLE = "IMAGINE_MESH_KEY"
_EPOCH_S = 1_577_836_800  # 2020-01-01: leaves a u32 boot number room until 2156
_MOST_BYTES = 4096  # of a key file: eight keys with times take half of it
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def write_new_keys(path: Path, ground_path: Path | None = None) -> KeyRing:
    """Create a key file (mode 0600) and return its keys; with `ground_path` also one that signs, for the ground.

    Raises InputError if a file exists, so that a swarm's key is never lost by accident, or cannot be written.
    """
    ring = KeyRing.of(secrets.token_bytes(KEY_BYTES))
    if ground_path is not None:
        if ground_path.absolute() == path.absolute():
            raise InputError(f"{path}: is named for the drones and for the ground: its signing key needs another file")
        sign = secrets.token_bytes(KEY_BYTES)
        ring = KeyRing(ring.keys, ground_public(sign), sign)
        if path.exists():  # before the first of the two is made
            raise InputError(f"{path}: exists already; choose another name, or remove it first")
        _create(ground_path, format_ring(ring))
    _create(path, format_ring(ring.for_drones()))
    return ring


def rotate_keys(path: Path, ground_path: Path | None, unix_time_s: float, after_s: float, overlap_s: float) -> KeyRing:
    """Add a new key to a key file, and the same to the ground's; return the drones' ring.

    The new key sends in `after_s`; the others are accepted for `overlap_s` from then on. Raises InputError if a file
    is not a sound key file, or the two do not belong together.
    """
    ring = load_keys(path)
    ground = None if ground_path is None else load_keys(ground_path)
    if ground is not None and ground.for_drones() != ring:
        raise InputError(f"{ground_path}: is not the ground's part of {path}")
    if ground is None and ring.ground_verify is not None:
        raise InputError(f"{path}: these drones want signed orders: name the ground's file too, with --ground")
    fresh = ring.rotated(lambda: secrets.token_bytes(KEY_BYTES), unix_time_s, after_s, overlap_s)
    if ground is not None and ground_path is not None:
        _replace(ground_path, format_ring(KeyRing(fresh.keys, ground.ground_verify, ground.ground_sign)))
    _replace(path, format_ring(fresh))
    return fresh


def load_keys(path: Path) -> KeyRing:
    """Read a key file. Raises InputError if it is unreadable, readable for others, or does not hold sound keys."""
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            content = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: the mesh key cannot be read: {error.strerror}") from error
    if mode & _OTHERS:
        raise InputError(f"{path}: others on this machine can read or change the mesh key; chmod 600 {path}")
    try:
        text = content.decode("ascii")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a key file; make one with `imagine keygen`") from error
    if len(content) > _MOST_BYTES:
        raise InputError(f"{path}: is too long for a key file; make one with `imagine keygen`")
    return parse_ring(text, str(path))


def find_keys(path: Path | None, environ: Mapping[str, str]) -> KeyRing:
    """Return the keys of the file, or else of the variable IMAGINE_MESH_KEY, which holds what a file would.

    Raises InputError if there is neither, or the keys are not sound.
    """
    if path is not None:
        return load_keys(path)
    if text := environ.get(KEY_VARIABLE):
        return parse_ring(text, KEY_VARIABLE)
    raise InputError(f"no mesh key: name a key file or set {KEY_VARIABLE}; make one with `imagine keygen`")


def start_sealer(keys: KeyRing, own: int, boot_file: Path, unix_time_s: float) -> Sealer:
    """Return the sealer of a node that starts now, under a boot number of its own, with a random first counter.

    Where the clock is behind the last start, that start counts as the time: a key that had ended stays so. Raises
    InputError where the boot number cannot be remembered, and for keys that are not this node's.
    """
    boot = next_boot_number(boot_file, unix_time_s)
    return Sealer(keys, own, boot, max(unix_time_s, _EPOCH_S + boot - 1), 1 + secrets.randbelow(2**31 - 1))


def _create(path: Path, text: str) -> None:
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise InputError(f"{path}: exists already; choose another name, or remove it first") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _replace(path: Path, text: str) -> None:
    fresh = path.with_name(path.name + ".new")
    fresh.unlink(missing_ok=True)
    _create(fresh, text)
    fresh.replace(path)


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
