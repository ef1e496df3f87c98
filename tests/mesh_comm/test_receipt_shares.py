"""How the bytes of a message are shared out among its tiles."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from imagine.mesh_comm.receipts import shares


@given(st.integers(0, 1200), st.lists(st.integers(0, 400), min_size=1, max_size=40))
def test_shares_sum_to_what_was_sent_and_none_is_off_by_a_byte(size: int, parts: list[int]) -> None:
    told = shares(size, parts)
    assert sum(told) == size
    if any(parts):
        assert all(abs(share - size * part / sum(parts)) < 1.0 for share, part in zip(told, parts, strict=True))


def test_the_largest_remainder_is_rounded_up_and_of_equal_ones_the_earlier() -> None:
    assert shares(10, [1, 1, 1]) == [4, 3, 3]
    assert shares(100, [33, 33, 1]) == [49, 49, 2]
    assert shares(3, [0, 0]) == [2, 1]
