"""A model is evaluated with the sensor that its contract names."""

import dataclasses

import pytest

pytest.importorskip("onnx", reason="the train extra is not installed")

from tiny_policy import make_contract, write_policy

from imagine.core.contract import LidarContract
from imagine.core.errors import InputError
from imagine.core.lidar import LD19, PRESETS
from imagine.train.policies import load_policy


@pytest.mark.parametrize("beams", [None, 64])
@pytest.mark.parametrize("name", PRESETS)
def test_a_model_is_evaluated_with_its_own_sensor(name, beams, tmp_path):
    spec = PRESETS[name] if beams is None else dataclasses.replace(PRESETS[name], beams=beams)
    path = write_policy(tmp_path / "model.onnx", make_contract(lidar=LidarContract.of(spec)))
    assert load_policy(path).env.lidar_spec == spec


def test_a_sensor_that_the_twin_has_not_is_refused_by_name(tmp_path):
    spec = dataclasses.replace(LD19, range_max=30.0)
    path = write_policy(tmp_path / "model.onnx", make_contract(lidar=LidarContract.of(spec)))
    with pytest.raises(InputError, match=r"model\.onnx: contract: lidar: .*ld19"):
        load_policy(path)
