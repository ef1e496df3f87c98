import imagine.train  # sets up OpenMP, so it comes before torch  # isort: skip

import sys
from pathlib import Path

import pytest
import torch

assert imagine.train
sys.path.append(str(Path(__file__).resolve().parents[1] / "onboard"))  # whose tiny policies are of use here too


@pytest.fixture(autouse=True)
def one_thread():
    """Small networks are quickest on one thread, above all beside other work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
