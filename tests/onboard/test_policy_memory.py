"""What a policy remembers in flight: from decision to decision, anew after a rescue, and the same in every replay."""

from __future__ import annotations

import numpy as np
import pytest
from flat_world import FlatFlight, make_runner
from onnx import TensorProto, helper
from tiny_policy import make_contract, make_model, write_policy

from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError, WorkError
from imagine.core.frames import Pose
from imagine.core.lidar import LD19
from imagine.core.mapping import MapSettings
from imagine.core.vehicle_limits import VehicleLimits
from imagine.onboard.policy import OnnxPolicy, check_fit
from imagine.onboard.policy_decisions import PolicyDecisions
from imagine.onboard.settings import DroneSettings, LaunchPose

HERE = Pose(0.0, 0.0, 0.0)


class Counting:
    """A policy whose state is how many decisions it remembers; the faster it flies the more they are."""

    def __init__(self, **contract) -> None:
        self.contract = make_contract(state_size=1, **contract)
        self.remembered: list[float] = []
        self.error: str | None = None
        self.next_state: np.ndarray | None = None

    def infer(self, observation, state):
        self.remembered.append(float(state[0]))
        if self.error is not None:
            raise WorkError(self.error)
        following = state + 1.0 if self.next_state is None else self.next_state
        return np.array([0.01 * state[0], 0.0], np.float32), following.astype(np.float32)


def decide(decisions: PolicyDecisions, flying: bool, times: int = 1):
    return [decisions.next_velocity(dict, HERE, is_flying=flying) for _ in range(times)]


def test_each_decision_remembers_those_before_it():
    policy = Counting(action=ActionSpec(decision_ticks=3))
    decide(PolicyDecisions(policy), flying=True, times=9)
    assert policy.remembered == [0.0, 1.0, 2.0]


def test_nothing_is_remembered_of_the_time_before_the_policy_flies():
    policy = Counting()
    decisions = PolicyDecisions(policy)
    decide(decisions, flying=False, times=20)
    assert policy.remembered == [0.0] * 20
    decide(decisions, flying=True, times=3)
    assert policy.remembered[20:] == [1.0, 2.0, 3.0]  # the decision that made it fly is the first


def test_half_a_second_of_waiting_is_bridged_and_a_rescue_is_not():
    policy = Counting()
    decisions = PolicyDecisions(policy)
    decide(decisions, flying=True, times=4)
    decide(decisions, flying=False, times=5)
    decide(decisions, flying=True)
    assert policy.remembered[-1] == 9.0
    decide(decisions, flying=False, times=6)
    decide(decisions, flying=True)
    assert policy.remembered[-2:] == [0.0, 1.0]


@pytest.mark.parametrize(
    ("state", "failure"), [(np.array([np.nan]), "state is not finite"), (np.zeros(3), "state has shape (3,)")]
)
def test_a_state_that_cannot_be_kept_is_a_failure_and_the_old_one_stays(state, failure):
    policy = Counting()
    decisions = PolicyDecisions(policy)
    decide(decisions, flying=True, times=2)
    policy.next_state = state
    ((velocity, reason),) = decide(decisions, flying=True)
    assert velocity is None
    assert failure in reason
    policy.next_state = None
    decide(decisions, flying=True)
    assert policy.remembered == [0.0, 1.0, 2.0, 2.0]


def test_a_failed_decision_is_forgotten():
    policy = Counting()
    decisions = PolicyDecisions(policy)
    decide(decisions, flying=True, times=3)
    policy.error = "out of memory"
    assert decide(decisions, flying=True) == [(None, "out of memory")]
    policy.error = None
    decide(decisions, flying=True)
    assert policy.remembered[-1] == 3.0


def test_a_flight_begins_with_nothing_and_its_replay_is_the_same_bit_for_bit():
    drone = DroneSettings(policy=None, launch=LaunchPose(x=1.5, y=1.5))
    policy = Counting()
    flight = FlatFlight(drone, policy)
    flight.fly_until(lambda output: output.status.decider == "policy", longest_s=10.0)
    asked = len(policy.remembered)
    assert policy.remembered[-1] == 0.0
    for _ in range(12):
        flight.tick()
    assert policy.remembered[asked:] == [float(n + 1) for n in range(12)]
    again = make_runner(drone, Counting())
    assert repr([again.tick(inputs) for inputs in flight.inputs]) == repr(flight.outputs)


def model_with_memory(size: int):
    """A model that adds what it sees of motion to a state of `size` numbers, besides what the tiny one does."""
    model = make_model(make_contract())
    graph = model.graph
    graph.input.append(helper.make_tensor_value_info("state", TensorProto.FLOAT, ["batch", size]))
    graph.output.append(helper.make_tensor_value_info("next_state", TensorProto.FLOAT, ["batch", size]))
    graph.node.append(helper.make_node("Add", ["state", "motion"], ["next_state"]))
    return model


def test_a_model_is_given_its_state_and_gives_the_next(tmp_path):
    contract = make_contract(state_size=3)
    policy = OnnxPolicy.load(write_policy(tmp_path / "p.onnx", contract, model_with_memory(3)))
    observation = {name: np.full(shape, 0.5, np.float32) for name, shape in contract.observation.shapes.items()}
    action, state = policy.infer(observation, np.array([1.0, 2.0, 3.0], np.float32))
    assert action.tolist() == [1.0, 0.0]
    assert state.tolist() == [1.5, 2.5, 3.5]
    check_fit(contract, LD19, MapSettings(), VehicleLimits(), "p.onnx")


@pytest.mark.parametrize(
    ("size", "model", "message"),
    [
        (3, None, r"has inputs \[.*'state'.*\], the graph has"),
        (0, 3, r"has inputs .*, the graph has .*'state'"),
        (4, 3, r"'state' has shape \[4\] after the batch axis, the graph has"),
    ],
)
def test_a_model_whose_memory_is_not_what_its_contract_says_is_refused(tmp_path, size, model, message):
    contract = make_contract(state_size=size)
    path = write_policy(tmp_path / "p.onnx", contract, None if model is None else model_with_memory(model))
    with pytest.raises(InputError, match=message):
        OnnxPolicy.load(path)


def test_a_model_that_forgets_to_give_its_state_is_refused(tmp_path):
    model = model_with_memory(3)
    del model.graph.output[1]
    path = write_policy(tmp_path / "p.onnx", make_contract(state_size=3), model)
    with pytest.raises(InputError, match="the graph has no output 'next_state'"):
        OnnxPolicy.load(path)


def test_what_decides_for_a_team_is_refused_by_a_drone():
    contract = make_contract(paradigm="ctce", level_shape=(5, 32, 32))
    with pytest.raises(InputError, match=r"contract: paradigm: .*ctce.* whole team .*imagine evaluate"):
        check_fit(contract, LD19, MapSettings(), VehicleLimits(), "team.onnx")
