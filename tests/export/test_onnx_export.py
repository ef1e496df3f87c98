import json
import logging

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from imagine.core.contract import CONTRACT_KEY, PolicyContract
from imagine.core.errors import InputError, WorkError
from imagine.core.observation_spec import ObservationSpec
from imagine.export import onnx_export
from imagine.export.onnx_export import export_onnx, inspect, parity
from imagine.onboard.policy import OnnxPolicy
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import Checkpoint, actor_of, load_checkpoint, save_checkpoint
from imagine.train.evaluation import evaluate
from imagine.train.networks import Actor, Critic, NetworkSettings
from imagine.train.policies import load_policy
from imagine.train.settings import TrainSettings


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with the checkpoint of a policy that never learned, and an evaluation."""
    folder = tmp_path_factory.mktemp("run")
    torch.manual_seed(3)
    settings = TrainSettings()
    actor = Actor(NetworkSettings(), settings.env.observation, settings.env.action.size)
    torch.nn.init.normal_(actor.mean.weight)  # actions that fill the range
    critic = Critic(NetworkSettings(), settings.env.observation)
    checkpoint = Checkpoint(
        settings, "ppo", {"imitation": 10, "ppo": 20}, 1, 2.5, actor.state_dict(), critic.state_dict(), {}, {},
        record={"run": "test", "seed": 0, "git_commit": "abc"},
    )  # fmt: skip
    save_checkpoint(checkpoint, folder / "checkpoints" / "latest.pt")
    (folder / "evaluation.json").write_text(json.dumps({"rows": [{"level": "4", "coverage_mean": 0.97}]}))
    return folder


@pytest.fixture(scope="module")
def model(run):
    path = run / "model.onnx"
    export_onnx(run, path, name="test-policy")
    return path


def test_the_model_is_the_network_for_any_batch(run, model):
    actor = actor_of(load_checkpoint(run), "run")
    session = onnxruntime.InferenceSession(str(model))
    rng = np.random.default_rng(5)
    for batch in (1, 7, 300):
        inputs = {
            node.name: rng.uniform(-1, 1, (batch, *node.shape[1:])).astype(np.float32) for node in session.get_inputs()
        }
        with torch.no_grad():
            expected = actor(*(torch.from_numpy(inputs[key]) for key in ("views", "lidar", "motion"))).numpy()
        (action,) = session.run(["action"], inputs)
        assert action.shape == (batch, 2)
        assert np.abs(expected).max() > 0.3
        np.testing.assert_allclose(action, expected, atol=1e-5)


def test_the_contract_says_how_it_was_made_and_what_it_needs(run, model):
    found = inspect(model)
    contract = found.contract
    env = ExplorationSettings()
    assert contract.name == "test-policy"
    assert (contract.observation, contract.action) == (env.observation, env.action)
    assert contract.lidar.beams == 360
    assert contract.training["agent_steps"] == {"imitation": 10, "ppo": 20}
    assert contract.training["git_commit"] == "abc"
    assert contract.training["evaluation"]["rows"][0]["coverage_mean"] == 0.97
    assert contract.training["parity_max_difference"] <= 1e-5
    assert contract.weights_sha256 == found.weights_sha256
    assert found.file_bytes == model.stat().st_size < 2_000_000
    assert found.inputs == env.observation.shapes
    assert found.outputs == {"action": (2,)}
    assert found.parameters > 50_000


def test_a_drone_and_the_evaluation_take_it(model):
    policy = OnnxPolicy.load(model)
    shapes = policy.contract.observation.shapes
    action, _ = policy.infer({name: np.zeros(shape, np.float32) for name, shape in shapes.items()}, np.zeros(0, "f"))
    assert action.shape == (2,)
    (row,) = evaluate(load_policy(model), ["0"], drones=(1,), episodes=1)
    assert row["policy"] == "test-policy"


def test_nothing_of_the_exporting_machine_is_in_the_file(model):
    content = model.read_bytes()
    assert b"site-packages" not in content
    assert b"train/networks" not in content


def test_changed_weights_are_noticed(model, tmp_path):
    proto = onnx.load(model)
    weights = max(proto.graph.initializer, key=lambda tensor: len(tensor.raw_data))
    weights.raw_data = weights.raw_data[:-4] + b"\0\0\0\0"
    onnx.save(proto, tmp_path / "changed.onnx")
    with pytest.raises(InputError, match=r"changed\.onnx: its weights hash to"):
        inspect(tmp_path / "changed.onnx")


def test_a_contract_that_does_not_fit_its_graph_is_refused(model, tmp_path):
    proto = onnx.load(model)
    (entry,) = [prop for prop in proto.metadata_props if prop.key == CONTRACT_KEY]
    contract = PolicyContract.from_json(entry.value, "test")
    wider = contract.observation.model_copy(update={"lidar_sectors": 128})
    entry.value = contract.model_copy(update={"observation": wider}).to_json()
    onnx.save(proto, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=r"other\.onnx: .*lidar"):
        inspect(tmp_path / "other.onnx")


@pytest.mark.parametrize("content", [b"", b"not a model", None])
def test_what_is_no_model_is_refused_by_name(model, tmp_path, content):
    path = tmp_path / "bad.onnx"
    path.write_bytes(model.read_bytes()[:5000] if content is None else content)
    with pytest.raises(InputError, match=r"bad\.onnx"):
        inspect(path)
    with pytest.raises(InputError, match=r"bad\.onnx"):
        load_policy(path)


def test_a_bad_checkpoint_is_an_input_error_and_writes_nothing(tmp_path):
    (tmp_path / "bad.pt").write_text("no")
    with pytest.raises(InputError, match=r"bad\.pt"):
        export_onnx(tmp_path / "bad.pt", tmp_path / "out.onnx")
    with pytest.raises(InputError, match=r"absent"):
        export_onnx(tmp_path / "absent", tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()


def test_a_model_that_differs_from_its_network_is_never_written(run, model, tmp_path, monkeypatch):
    other = actor_of(load_checkpoint(run), "run")
    torch.nn.init.normal_(other.mean.weight)
    assert parity(other, model.read_bytes()) > 1e-2
    monkeypatch.setattr(onnx_export, "_to_onnx", lambda *_: model.read_bytes())
    monkeypatch.setattr(onnx_export, "actor_of", lambda *_: other)
    with pytest.raises(WorkError, match="ONNX and torch differ"):
        export_onnx(run, tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()


def test_the_exporter_leaves_the_log_alone(model):
    assert logging.getLogger("torch.onnx").level == logging.NOTSET


@pytest.mark.parametrize("head", ["choice", "gaussian"])
def test_the_proof_tells_networks_apart_that_see_frontiers(head):
    """Of a choice, too, which is by the scores of all that is seen."""
    spec = ObservationSpec(view_cells=16, lidar_sectors=17, frontiers=4)
    small = NetworkSettings(head=head, view_channels=(4, 4, 4), critic_channels=(4, 4), lidar_channels=2, hidden=16)

    def network(seed):
        torch.manual_seed(seed)
        return Actor(small, spec, 2).eval()

    model = onnx_export._to_onnx(network(0))
    assert parity(network(0), model) <= 1e-5
    assert parity(network(1), model) > 1e-2
