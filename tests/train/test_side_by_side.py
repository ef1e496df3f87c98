import threading

import pytest
import torch

from imagine.train.side_by_side import side_by_side


@pytest.fixture
def two_threads():
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


def test_both_run_at_once_on_a_thread_each_of_torchs(two_threads):
    meeting = threading.Barrier(2, timeout=30.0)

    def work(name):
        meeting.wait()  # passes only while both run
        return name, torch.get_num_threads(), threading.get_ident()

    one, other = side_by_side(lambda: work("one"), lambda: work("other"))
    assert (one[:2], other[:2]) == (("one", 1), ("other", 1))
    assert one[2] != other[2]
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("failing", [0, 1])
def test_a_failure_is_raised_once_the_other_is_done_too(two_threads, failing):
    done = []

    def work(number):
        if number == failing:
            raise ValueError(str(number))
        done.append(number)

    with pytest.raises(ValueError, match=str(failing)):
        side_by_side(lambda: work(0), lambda: work(1))
    assert done == [1 - failing]
    assert torch.get_num_threads() == 2


def test_a_single_thread_does_one_after_the_other():
    torch.set_num_threads(1)
    assert side_by_side(threading.get_ident, threading.get_ident) == (threading.get_ident(),) * 2
