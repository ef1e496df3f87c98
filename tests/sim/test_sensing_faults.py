"""What a LiDAR model takes from ideal scans: lost beams, missed and dark surfaces, and what differs by episode."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from imagine.core.config import check_settings
from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec
from imagine.sim.level import load_level
from imagine.sim.lidar_model import LidarModel
from imagine.sim.sensing import Sensing
from imagine.sim.workers import Workers

SPEC = LidarSpec(beams=360, noise_std=0.01)
ROOM, HOUSE = load_level("0"), load_level("6")
WORLDS = 60
MIDDLE = np.tile([3.0, 3.0, 0.0], (WORLDS, 1, 1))


def make(model: LidarModel, worlds: int = WORLDS, spec: LidarSpec = SPEC) -> Sensing:
    sensing = Sensing(worlds, 1, spec, 3, Workers(1), model=model)
    for world in range(worlds):
        sensing.set_level(world, ROOM)
    return sensing


def scans(model: LidarModel, tick: int = 0, spec: LidarSpec = SPEC) -> NDArray[np.float32]:
    """Return scans `[60, 360]` from the middle of the empty room."""
    return make(model, spec=spec).scan(MIDDLE, np.zeros_like(MIDDLE), 0.08, tick)[:, 0]


def test_by_default_the_sensors_own_noise_is_all() -> None:
    ideal = scans(LidarModel(noise_std_m=0.0))
    error = scans(LidarModel()) - ideal
    assert np.isfinite(error).all()
    assert error.std() == pytest.approx(0.01, rel=0.02)


def test_noise_grows_with_range_where_asked_to() -> None:
    error = scans(LidarModel(noise_std_m=0.005, noise_per_m=0.01)) - scans(LidarModel(noise_std_m=0.0))
    near, far = error[:, [0, 90, 180, 270]], error[:, [45, 135, 225, 315]]
    assert near.std() == pytest.approx(0.005 + 0.03, rel=0.15)
    assert far.std() == pytest.approx(0.005 + 0.01 * 3 * np.sqrt(2), rel=0.15)


@pytest.mark.parametrize("invalid", [True, False])
def test_dropouts_come_at_their_rate_and_leave_the_other_beams_alone(invalid: bool) -> None:
    whole = scans(LidarModel())
    thinned = scans(LidarModel(dropout=(0.1, 0.1), dropout_invalid=invalid))
    lost = np.isnan(thinned) if invalid else np.isinf(thinned)
    assert lost.mean() == pytest.approx(0.1, abs=0.01)
    np.testing.assert_array_equal(thinned[~lost], whole[~lost])
    again = scans(LidarModel(dropout=(0.1, 0.1), dropout_invalid=invalid), tick=1)
    assert (np.isfinite(again) != np.isfinite(thinned)).any()


def test_misses_grow_with_the_square_of_the_range() -> None:
    spec = LidarSpec(beams=360, range_max=6.0)
    missed = np.isinf(np.concatenate([scans(LidarModel(miss_at_max=0.8), tick, spec) for tick in range(40)]))
    range_m = scans(LidarModel(noise_std_m=0.0), spec=spec)[0]
    for low, high in ((3.0, 3.3), (3.3, 3.8), (3.8, 4.3)):
        bin_ = (range_m >= low) & (range_m < high)
        assert missed[:, bin_].mean() == pytest.approx(0.8 * np.mean((range_m[bin_] / 6.0) ** 2), rel=0.05)


def test_dark_patches_stay_where_they_are_and_show_from_near() -> None:
    """From afar a dark stretch of wall gives no return, tick after tick; from near it does."""
    model = LidarModel(dark_share=0.3, dark_range_m=2.0)
    sensing = make(model)
    first = np.isinf(sensing.scan(MIDDLE, np.zeros_like(MIDDLE), 0.08, 0)[:, 0])
    again = np.isinf(sensing.scan(MIDDLE, np.zeros_like(MIDDLE), 0.08, 1)[:, 0])
    assert first.mean() == pytest.approx(0.3, abs=0.05)
    assert (first == again).mean() > 0.99
    assert not np.array_equal(first[0], first[1])  # each world has its own
    runs = np.count_nonzero(np.diff(first.astype(int), axis=1), axis=1)
    assert runs.mean() < 60  # stretches of half a metre, not single beams
    near = MIDDLE.copy()
    near[:, 0, 0] = 1.0
    scan = sensing.scan(near, np.zeros_like(near), 0.08, 0)[:, 0]
    assert np.isfinite(scan[:, 150:210]).all()


def test_what_is_left_open_is_drawn_anew_for_every_episode_by_the_worlds_generator() -> None:
    model = LidarModel(noise_scale=(0.5, 2.0), dropout=(0.0, 0.2))
    sensing = make(model)
    for world in range(WORLDS):
        sensing.randomise(world, np.random.default_rng(world))
    scan = sensing.scan(MIDDLE, np.zeros_like(MIDDLE), 0.08, 0)[:, 0]
    ideal = scans(LidarModel(noise_std_m=0.0))
    widths = np.nanstd(scan - ideal, axis=1)
    assert widths.min() < 0.008 < 0.016 < widths.max()
    shares = np.isnan(scan).mean(axis=1)
    assert shares.min() < 0.05 < 0.12 < shares.max() < 0.27
    twin = make(model)
    twin.randomise(7, np.random.default_rng(7))
    np.testing.assert_array_equal(scan[7], twin.scan(MIDDLE, np.zeros_like(MIDDLE), 0.08, 0)[7, 0])
    twin.randomise(7, np.random.default_rng(8))
    assert not np.array_equal(scan[7], twin.scan(MIDDLE, np.zeros_like(MIDDLE), 0.08, 0)[7, 0])


def test_skewed_scans_have_the_same_faults() -> None:
    model = LidarModel(dropout=(0.1, 0.1), miss_at_max=0.2)
    still = np.zeros_like(MIDDLE)
    plain = make(model).scan(MIDDLE, still, 0.08, 2)
    skewed = make(model.model_copy(update={"skew": True})).scan(MIDDLE, still, 0.08, 2)
    np.testing.assert_allclose(skewed, plain, rtol=1e-6)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("dropout", [0.2, 0.1], "lowest first"),
        ("dropout", [0.0, 1.5], "within 0 and 1"),
        ("noise_scale", [-0.1, 1.0], "within 0 and 10"),
        ("noise_per_m", 0.5, "within 0 and 0.1"),
        ("dark_range_m", 0.0, "greater than 0"),
        ("noise_std", 0.1, "did you mean 'noise_std_m'"),
    ],
)
def test_impossible_models_are_refused(key: str, value: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        check_settings(LidarModel, {key: value}, "lidar.yaml")


def test_models_are_immutable() -> None:
    with pytest.raises(ValidationError):
        LidarModel().skew = True  # type: ignore[misc]
