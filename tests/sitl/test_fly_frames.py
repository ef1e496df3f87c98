"""`imagine fly --sim --frame` with real processes: drones that do not know how they stand to each other find out."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import fly, run_imagine

pytestmark = pytest.mark.sitl


def test_two_drones_without_a_shared_frame_place_each_other_from_their_maps(tmp_path: Path) -> None:
    picture = tmp_path / "map.png"
    command = ["--level", "6", "--drones", "2", "--lockstep", "--ticks", "200", "--seed", "2", "--frame", "unknown"]
    found = fly(tmp_path / "out.json", *command, "--map", str(picture))
    assert found["frame"] == "unknown"
    for drone, other in zip(found["drones"], (2, 1), strict=True):
        assert (drone["failsafes"], drone["error"]) == ([], "")
        assert drone["pose_rmse_m"] < 0.15  # in the twin's frame, although it knows nothing of that
        (peer,) = drone["peers"]
        assert (peer["id"], peer["standing"]) == (other, "trusted")
        assert 3.0 < peer["placed_s"] < 20.0  # never at once: trust needs maps that grew since the first estimate
        assert drone["receipts"]["tile"]["cells"] > 1000
    assert picture.exists()


def test_a_layout_places_everybody_from_the_first_word(tmp_path: Path) -> None:
    command = ["--level", "0", "--drones", "2", "--lockstep", "--ticks", "60", "--frame", "layout"]
    found = fly(tmp_path / "out.json", *command)
    for drone in found["drones"]:
        (peer,) = drone["peers"]
        assert peer["standing"] == "given"
        assert peer["placed_s"] < 3.0
        assert drone["pose_rmse_m"] < 0.15


def test_a_frame_that_is_none_is_refused() -> None:
    done = run_imagine("fly", "--sim", "--frame", "lost", "--ticks", "10")
    assert done.returncode == 2
    assert done.stderr == "imagine: --frame lost: expected shared, layout, unknown\n"
