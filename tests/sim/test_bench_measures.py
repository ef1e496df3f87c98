"""The benchmark's instruments: stop-watches, memory, growth, and what is compared with what."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from imagine.core.frontier import FrontierField
from imagine.core.lidar import Scan
from imagine.sim.bench.comparison import comparison
from imagine.sim.bench.growth import growth
from imagine.sim.bench.laps import Laps, StageWatch, ratio
from imagine.sim.bench.memory import array_bytes
from imagine.sim.bench.plan import BenchPlan, make_batch

SMALL = BenchPlan(
    level="0", beams=(360,), worlds=(1, 2, 8), drones=(1, 4), seconds=0.1, rounds=2,
    compared_worlds=4, compared_drones=2, worlds_for_drones=2,
    episode_ticks=20, random_ticks=3, growth_ticks=2, copies=1,
)  # fmt: skip


def test_arrays_are_counted_once_whoever_looks_at_them() -> None:
    whole = np.zeros((100, 10))
    scan, field = (
        Scan(0.0, np.zeros(3, np.float32)),
        FrontierField(np.zeros((4, 5), np.int16), np.zeros(9, np.uint8), np.zeros(9, np.uint8)),
    )
    seen = {"a": whole[:50], "b": whole[50:], "c": scan, "d": field}
    assert array_bytes(seen) == 8000 + 12 + 40 + 9 + 9
    assert array_bytes([seen, (seen, whole.T), {1: whole}]) == array_bytes(seen)
    assert array_bytes("text") == array_bytes(None) == 0


def test_a_batchs_arrays_are_found_wherever_they_are_kept() -> None:
    batch = make_batch(SMALL, 32, 2, 360)
    least = batch.maps.layers.nbytes + batch.maps.belief.nbytes + batch.twin.poses.nbytes + batch.air.state.known.nbytes
    assert least < array_bytes(batch) < 10 * least


def test_a_drone_takes_no_more_than_a_megabyte_and_a_half_on_the_largest_level() -> None:
    plan = BenchPlan(worlds=(8, 32), rounds=1, growth_ticks=30, seconds=0.05, compared_worlds=8, copies=1)
    told = growth(plan, "worlds", lambda _: None)
    for name in ("memory_a_drone", "resident_a_drone"):
        assert 0.2e6 < told[name]["value"] <= 1.5e6, name
        assert told[name]["drones"] == 3
    assert told["worlds_32"]["array_bytes_a_drone"] <= 1.5e6


_WRITE = """
import numpy as np
from imagine.sim.bench.memory import free_bytes, resident_bytes
before = resident_bytes()
written = np.ones(40_000_000 // 8)
print(resident_bytes() - before, written.sum() < free_bytes())
"""


def test_resident_memory_grows_by_what_is_written() -> None:
    # in a process of its own: this one may have memory to give that other tests left
    told = subprocess.run([sys.executable, "-c", _WRITE], capture_output=True, text=True, timeout=120, check=True)
    grown, has_room = told.stdout.split()
    assert 35e6 < int(grown) < 60e6
    assert has_room == "True"


def laps(*rounds: tuple[int, float, float]) -> Laps:
    steps, wall, cpu = zip(*rounds, strict=True)
    return Laps(list(steps), list(wall), list(cpu))


def test_rates_and_ratios_are_medians_over_rounds() -> None:
    fast, slow = (
        laps((100, 1.0, 2.0), (300, 1.0, 2.0), (200, 1.0, 2.0)),
        laps((10, 1.0, 1.0), (10, 1.0, 1.0), (10, 2.0, 1.0)),
    )
    told = fast.told()
    assert (told["value"], told["per_cpu_s"], told["low"], told["high"], told["rounds"]) == (200, 100, 100, 300, 3)
    assert ratio(fast, slow) == {"value": 30.0, "unit": "times", "per_cpu_s": 10.0, "low": 10.0, "high": 40.0}


def test_a_stop_watch_counts_what_happens_within() -> None:
    watch = Laps()
    watch.start_round()
    with watch.timed(3):
        sum(range(300_000))
    inside = watch.cpu_s[0]
    sum(range(3_000_000))
    with watch.timed(4):
        pass
    assert watch.steps == [7]
    assert inside > 0.0
    assert watch.cpu_s[0] < 2.0 * inside + 1e-3


@dataclass
class Staged:
    stage_seconds: dict[str, float] | None


def test_stages_are_told_where_something_keeps_them() -> None:
    staged = Staged({"rays": 5.0})
    watch = StageWatch(staged)
    with watch:
        staged.stage_seconds = {"rays": 5.3, "field": 0.9}
    staged.stage_seconds = {"rays": 50.0, "field": 0.9}
    told = watch.told("batched", "8_beams", 1000)
    assert told["batched_stage_rays_8_beams"]["value"] == pytest.approx(300.0)
    assert told["batched_stage_field_8_beams"] == {
        "value": pytest.approx(900.0), "unit": "us/agent-step", "share": pytest.approx(0.75),
    }  # fmt: skip
    rest = watch.told("batched", "8_beams", 1000, cpu_s=1.5)["batched_stage_rest_8_beams"]
    assert (rest["value"], rest["share"]) == (pytest.approx(300.0), pytest.approx(0.2))
    for silent in (Staged(None), object()):
        watch = StageWatch(silent)
        with watch:
            pass
        assert watch.told("batched", "8_beams", 1000) == {}


def told_growth(**changes: Any) -> dict[str, dict[str, Any]]:
    return growth(replace(SMALL, **({"rounds": 3} | changes)), "worlds", lambda _: None)


def test_growth_is_told_by_size_and_memory_is_in_proportion_to_worlds() -> None:
    told = told_growth()
    for worlds in SMALL.worlds:
        row = told[f"worlds_{worlds}"]
        assert (row["worlds"], row["drones"], row["unit"]) == (worlds, 2, "agent-steps/s")
        assert row["value"] == pytest.approx(worlds * 2 / row["tick_s"])  # both are medians of three rounds
        assert row["per_cpu_s"] == pytest.approx(worlds * 2 / row["tick_cpu_s"])
    assert 0.3 < told["memory_growth_worlds"]["value"] < 1.1
    assert 0.2 < told["time_growth_worlds"]["value"] < 1.5
    line = told["memory_a_drone"]
    assert line["off"] < 0.05
    assert line["value"] * 8 * 2 + line["fixed"] == pytest.approx(
        told["worlds_8"]["array_bytes_a_drone"] * 16, rel=0.05
    )


def test_a_size_that_would_not_fit_is_left_out_and_says_why() -> None:
    told = told_growth(memory_limit_bytes=5e5)
    assert told["worlds_1"]["value"] > 0.0
    assert told["worlds_8"]["value"] is None
    assert "GB" in told["worlds_8"]["skipped"]
    assert told_growth(memory_limit_bytes=1.0)["worlds_1"]["value"] is None


def test_the_batched_step_is_compared_with_each_plain_one() -> None:
    told = comparison(SMALL, 360, "frontier") | comparison(SMALL, 360, "random")
    for ending in ("360_beams", "360_beams_random"):
        batched = told[f"batched_{ending}"]
        for who in ("plain", "plain_scipy", "plain_kernels"):
            rate, faster = told[f"{who}_{ending}"], told[f"batched_over_{who}_{ending}"]
            assert rate["low"] <= rate["value"] <= rate["high"]
            assert faster["per_cpu_s"] == pytest.approx(batched["per_cpu_s"] / rate["per_cpu_s"], rel=0.5)
        assert told[f"batched_over_plain_{ending}"]["per_cpu_s"] > 2.0
    stages = ("fly", "scan", "share", "derive", "observe", "rest")
    for who in ("batched", "plain", "plain_scipy", "plain_kernels"):
        shares = [told[f"{who}_stage_{stage}_360_beams"]["share"] for stage in stages]
        assert min(shares) > 0.0
        assert math.fsum(shares) == pytest.approx(1.0)
    batched = [told[f"batched_stage_{stage}_360_beams"]["value"] for stage in stages]
    assert math.fsum(batched) == pytest.approx(1e6 / told["batched_360_beams"]["per_cpu_s"], rel=0.5)
    assert told["plain_critic_360_beams"]["value"] > 0.0


def test_the_beams_that_are_measured_are_flown() -> None:
    assert make_batch(SMALL, 1, 1, 64).lidar.beams == 64


def test_the_settings_name_the_sensor_that_is_flown() -> None:
    spec = SMALL.settings(1, 1, 64, False).lidar_spec
    assert (spec.beams, spec.range_max, spec.increment) == (64, 12.0, pytest.approx(2.0 * math.pi / 64))
