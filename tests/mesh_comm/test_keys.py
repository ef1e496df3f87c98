"""Keys and boot numbers: kept safely, changed in step, and refused where they are not sound."""

from __future__ import annotations

import itertools
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.mesh_comm.keyring import KeyRing, SwarmKey, format_ring, ground_public, parse_ring
from imagine.mesh_comm.keys import (
    KEY_VARIABLE,
    find_keys,
    load_keys,
    next_boot_number,
    rotate_keys,
    start_sealer,
    write_new_keys,
)
from imagine.mesh_comm.seal import Rejected, Sealer

DAY = 86400.0
NOW = 1.8e9


def private(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    path.chmod(0o600)
    return path


def test_a_new_key_is_private_readable_back_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "swarm.key"
    ring = write_new_keys(path)
    assert load_keys(path) == ring
    assert len(ring.keys[0].secret) == 32
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(InputError, match="exists already"):
        write_new_keys(path)
    assert find_keys(path, {}) == find_keys(None, {KEY_VARIABLE: path.read_text()}) == ring
    with pytest.raises(InputError, match="cannot be written"):
        write_new_keys(tmp_path / "absent" / "swarm.key")


def test_one_file_for_drones_and_ground_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another file"):
        write_new_keys(tmp_path / "swarm.key", tmp_path / "swarm.key")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o644])
def test_a_key_file_that_others_can_touch_is_refused_with_the_remedy(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "swarm.key"
    write_new_keys(path)
    path.chmod(mode)
    with pytest.raises(InputError, match=f"chmod 600 {path}"):
        load_keys(path)


@pytest.mark.parametrize(
    "content",
    [
        b"", b"# nothing", b"ab" * 31, b"ab" * 33, b"zz" * 32, b"\xff" * 32, b"ab" * 32 + b" until=never",
        b"ab" * 32 + b" made=yesterday", b"ab" * 32 + b" accepted-until=2026-01-01T00:00:00Z", b"ground-sign=12",
        b"ab" * 32 + b"\n" + b"ab" * 32, b"ab" * 32 + b"\nground-verify=" + b"00" * 31, b"# " * 5000,
        b"ab" * 32 + b"\nground-sign=" + b"cd" * 32 + b"\nground-verify=" + b"ef" * 32, b"x=" + b"ab" * 32,
    ],
)  # fmt: skip
def test_a_damaged_key_file_is_refused_by_name_and_no_key_is_shown(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(InputError, match=r"swarm\.key") as caught:
        load_keys(private(tmp_path / "swarm.key", content))
    assert "abababab" not in str(caught.value)


def test_a_missing_key_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_keys(tmp_path / "none.key")
    with pytest.raises(InputError, match="cannot be read"):
        load_keys(tmp_path)
    with pytest.raises(InputError, match="keygen"):
        find_keys(None, {})
    with pytest.raises(InputError, match=KEY_VARIABLE):
        find_keys(None, {KEY_VARIABLE: "1234"})


times = st.integers(1_600_000_000, 4_000_000_000).map(float)


@given(st.lists(st.tuples(st.binary(min_size=32, max_size=32), times, times, times), max_size=4), st.booleans())
def test_any_ring_is_read_back_as_it_was_written(parts: list[tuple[bytes, float, float, float]], signs: bool) -> None:
    keys = [SwarmKey(secret, made, sends, until) for secret, made, sends, until in parts]
    keys.append(SwarmKey(bytes(32), sends_from=4.1e9))
    if len({key.id for key in keys}) == len(keys):
        sign = bytes(range(32))
        ring = KeyRing(tuple(keys), ground_public(sign) if signs else None, sign if signs else None).check("here")
        assert parse_ring(format_ring(ring), "here") == ring
        assert parse_ring(format_ring(ring.for_drones()), "here") == ring.for_drones()


def test_rotation_adds_a_key_that_both_files_know_and_lets_the_old_one_end(tmp_path: Path) -> None:
    drones, ground = tmp_path / "drones.key", tmp_path / "ground.key"
    first = write_new_keys(drones, ground)
    rotate_keys(drones, ground, NOW, after_s=DAY, overlap_s=DAY)
    ring = load_keys(drones)
    assert load_keys(ground).for_drones() == ring
    assert load_keys(ground).ground_sign == first.ground_sign
    old, new = ring.keys
    assert (old.secret, old.accepted_until) == (first.keys[0].secret, NOW + 2 * DAY)
    assert (new.made_at, new.sends_from) == (NOW, NOW + DAY)
    rotate_keys(drones, ground, NOW + 3 * DAY, after_s=0.0, overlap_s=DAY)
    assert load_keys(drones).keys[0].secret == new.secret  # what had ended is gone
    assert len(load_keys(drones).keys) == 2
    assert stat.S_IMODE(drones.stat().st_mode) == stat.S_IMODE(ground.stat().st_mode) == 0o600


def test_rotation_refuses_files_that_do_not_belong_together(tmp_path: Path) -> None:
    drones, ground, stranger = (tmp_path / name for name in ("drones.key", "ground.key", "other.key"))
    write_new_keys(drones, ground)
    write_new_keys(stranger)
    before = drones.read_text()
    for pair in ((drones, stranger), (stranger, ground), (drones, None)):
        with pytest.raises(InputError, match="ground"):
            rotate_keys(*pair, NOW, 0.0, 0.0)
    assert drones.read_text() == before


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_drones_that_get_the_new_file_one_after_another_hear_each_other_all_the_time(order: tuple[int, ...]) -> None:
    old = KeyRing.of(bytes(32))
    both = old.rotated(lambda: bytes(range(32)), NOW, after_s=DAY, overlap_s=DAY)
    rings = [old] * 3
    boot = 0
    for moment in range(4):  # every six hours one drone gets the file; all are started anew
        sealers = [Sealer(ring, own, boot := boot + 1, NOW + moment * DAY / 4) for own, ring in enumerate(rings, 1)]
        for a, b in itertools.permutations(sealers, 2):
            assert b.open(a.seal(b"", 0.0), 0.0).sender == a.own
        if moment < 3:
            rings[order[moment]] = both
    stolen = Sealer(old, 9, 1)
    late = Sealer(both, 1, 99, NOW + 2.1 * DAY)
    with pytest.raises(Rejected, match="ended"):
        late.open(stolen.seal(b"", 0.0), 0.0)


def test_boot_numbers_grow_whatever_the_clock_does(tmp_path: Path) -> None:
    path = tmp_path / "boot"
    numbers = [next_boot_number(path, at) for at in (1.8e9, 1.8e9, 0.0, 1.9e9)]
    assert all(later > earlier for earlier, later in itertools.pairwise(numbers))
    path.write_text("rubbish")
    with pytest.raises(InputError, match="boot"):
        next_boot_number(path, 2e9)


def test_a_boot_file_gets_its_folder_and_one_that_cannot_be_written_is_named_with_the_remedy(tmp_path: Path) -> None:
    assert next_boot_number(tmp_path / "new" / "folder" / "boot", 0.0) == 1
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file/boot: .*set boot_file"):
        next_boot_number(tmp_path / "file" / "boot", 2e9)


def test_a_clock_set_back_does_not_bring_an_ended_key_back(tmp_path: Path) -> None:
    ring = KeyRing.of(bytes(32)).rotated(lambda: bytes(range(32)), NOW, after_s=0.0, overlap_s=DAY)
    old = Sealer(bytes(32), 2, 1)
    assert start_sealer(ring, 1, tmp_path / "boot", NOW).open(old.seal(b"", 0.0), 0.0).sender == 2
    start_sealer(ring, 1, tmp_path / "boot", NOW + 2 * DAY)
    again = start_sealer(ring, 1, tmp_path / "boot", NOW)
    with pytest.raises(Rejected, match="ended"):
        again.open(old.seal(b"", 0.0), 0.0)
