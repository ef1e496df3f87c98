"""`imagine keygen` makes and changes key files; the doctor and the bench look at what rests on them."""

from __future__ import annotations

import json
from pathlib import Path

from command_line import environment, run_imagine

from imagine.mesh_comm.keys import load_keys


def test_keys_are_made_and_changed_for_drones_and_ground_together(tmp_path: Path) -> None:
    drones, ground = tmp_path / "drones.key", tmp_path / "ground.key"
    made = run_imagine("keygen", drones, "--ground", ground)
    assert made.returncode == 0
    assert "ground station only" in made.stdout
    changed = run_imagine("keygen", drones, "--ground", ground, "--rotate", "--after", "2", "--overlap", "3")
    assert changed.returncode == 0
    old, new = load_keys(drones).keys
    assert f"key {new.id:02x} added" in changed.stdout
    assert new.sends_from - new.made_at == 2 * 3600.0
    assert old.accepted_until - new.sends_from == 3 * 3600.0
    assert load_keys(ground).for_drones() == load_keys(drones)
    assert old.secret.hex() not in made.stdout + changed.stdout
    refused = run_imagine("keygen", drones, "--rotate")
    assert refused.returncode == 2
    assert "--ground" in refused.stderr


def test_the_doctor_reads_the_key_and_names_a_damaged_one(tmp_path: Path) -> None:
    out = tmp_path / "doctor.json"
    for text, state, word in (("00" * 32, "ok", "key "), ("abcd", "fault", "digits")):
        run_imagine("doctor", "--json", out, env=environment(IMAGINE_MESH_KEY=text))
        found = {finding["name"]: finding for finding in json.loads(out.read_text())}
        assert found["mesh key"]["state"] == state
        assert word in found["mesh key"]["detail"]
    assert "lo" in found["mesh multicast"]["detail"]


def test_the_bench_of_the_seal_measures_every_kind(tmp_path: Path) -> None:
    out = tmp_path / "seal.json"
    assert run_imagine("bench", "seal", "--datagrams", "200", "--json", out).returncode == 0
    rows = json.loads(out.read_text())
    assert {"open_scans", "refuse_forged_full", "open_signed"} <= set(rows)
    assert all(row["value"] > 0 for row in rows.values())
