"""The packing as docs/mesh.md tells it, in plain Python and by its numbers alone: it reads what the kernels wrote."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from imagine.core.evidence import TileKey
from imagine.mesh_comm import chances
from imagine.mesh_comm.codec import pack_ranges, pack_tile, pack_versions, range_codes

TABLE = json.loads(Path(chances.PATH).read_text())
EVEN = 32768


class Reader:
    """A range decoder over bytes, with chances that learn or not."""

    def __init__(self, data: bytes, chance: list[int], learns: bool) -> None:
        self.data, self.at, self.chance, self.learns = data, 4, list(chance), learns
        self.code, self.range = int.from_bytes(data[:4].ljust(4, b"\0"), "big"), 2**32 - 1

    def bit(self, context: int) -> int:
        c = self.chance[context]
        bound = self.range * c >> 16
        bit = int(self.code >= bound)
        if bit:
            self.code, self.range = self.code - bound, self.range - bound
        else:
            self.range = bound
        if self.learns and context:
            self.chance[context] = max(c - (c >> 5), 32) if bit else min(c + (65536 - c >> 5), 65504)
        while self.range < 2**24:
            self.code = self.code << 8 | (self.data[self.at] if self.at < len(self.data) else 0)
            self.range <<= 8
            self.at += 1
        return bit

    def number(self, first: int) -> int:
        k = 0
        while k < 39 and self.bit(first + k):
            k += 1
        value = 1
        for digit in range(k):
            value = 2 * value + self.bit(first + 40 + k if digit == 0 else 0)
        return value - 1

    def signed(self, first: int) -> int:
        value = self.number(first)
        return value // 2 if value % 2 == 0 else -(value + 1) // 2


def kind_of(value: int) -> int:
    return {0: 0, -8: 1, 8: 4}.get(value, 2 if value < 0 else 3)


def read_tile(data: bytes) -> list[list[int]]:
    bits = Reader(data, TABLE["tile"], learns=False)
    if bits.bit(1):
        return [[sum(bits.bit(0) << k for k in (4, 3, 2, 1, 0)) - 8 for _ in range(32)] for _ in range(32)]
    rows: list[list[int]] = []
    for y in range(32):
        row: list[int] = []
        for x in range(32):
            west = row[-1] if x else (rows[-1][0] if y else 0)
            w = kind_of(west)
            n = nw = ne = w
            if y:
                n = kind_of(rows[-1][x])
                nw = kind_of(rows[-1][x - 1]) if x else n
                ne = kind_of(rows[-1][x + 1]) if x < 31 else n
            row.append(read_cell(bits, west, w, n, nw, ne))
        rows.append(row)
    return rows


def read_cell(bits: Reader, west: int, w: int, n: int, nw: int, ne: int) -> int:
    if not bits.bit(2 + 125 * w + 25 * n + 5 * nw + ne):
        return west
    for k, value in enumerate((-8, 0, 8)):
        if value != west and bits.bit(627 + 125 * k + 25 * w + 5 * n + ne):
            return value
    p, t = bits.bit(1002 + 5 * w + n), 1
    for _ in range(3):
        t = 2 * t + bits.bit(1027 + 8 * (25 * p + 5 * w + n) + t)
    return t - 8 if p else 8 - t


def read_scan(data: bytes, beams: int, m: int) -> list[int]:
    bits = Reader(data, TABLE["scan"], learns=True)
    a = b = 2
    d1 = d2 = v = 0
    p, after_hit, codes = 16 * m, False, []
    for _ in range(beams):
        c, kind = 1 + 2 * (3 * a + b), a
        if bits.bit(c):
            kind = [other for other in (0, 1, 2) if other != a][bits.bit(c + 1)]
        code = kind
        if kind == 2:
            r = min((abs(d1) + abs(d2)).bit_length(), 6) if after_hit else 7
            s = 0 if d1 == 0 else (1 if d1 > 0 else 2)
            d = bits.number(43 + 80 * r)
            if d and bits.bit(19 + 3 * r + s):
                d = -d
            code = min(max(p + v + 8 >> 4, 2), m) + d
            if abs(d) > 8:
                p, v = 16 * code, 0
            else:
                p, v = p + v + (16 * d >> 1), v + (16 * d >> 2)
            d1, d2 = d, d1
        codes.append(code)
        b, a, after_hit = a, kind, kind == 2
    return codes


def read_versions(data: bytes) -> dict[tuple[int, int], int]:
    bits = Reader(data, [EVEN] * 401, learns=True)
    listed: dict[tuple[int, int], int] = {}
    column, row, first, version = -161, 0, 0, 0
    for _ in range(bits.number(1)):
        step = bits.number(81)
        column += step
        if step:
            row = first = first + bits.signed(161)
        else:
            row += bits.signed(241)
        version += bits.signed(321)
        listed[column, row] = version
    return listed


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([0.0, 0.02, 0.3, 1.0]))
def test_tiles(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    smooth = np.where(np.add.outer(np.arange(32), np.arange(32)) % 40 < rng.integers(1, 40), -8, 8)
    cells = np.where(rng.random((32, 32)) < share, rng.integers(-8, 9, (32, 32)), smooth).astype(np.int8)
    assert read_tile(pack_tile(cells)) == cells.tolist()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 0.2), st.sampled_from([0.35, 4.0, 12.0]))
def test_scans(seed: int, noise_m: float, cap: float) -> None:
    rng = np.random.default_rng(seed)
    ranges = (3.0 + np.sin(np.arange(90) / 9.0) * rng.uniform(0, 3) + rng.normal(0, noise_m, 90)).astype(np.float32)
    ranges[rng.random(90) < 0.1] = np.nan
    codes = range_codes(ranges, 0.05, cap).tolist()
    assert read_scan(pack_ranges(ranges, 0.05, cap), 90, round(cap * 100) + 2) == codes


@settings(max_examples=25, deadline=None)
@given(
    st.dictionaries(
        st.builds(TileKey, st.integers(-160, 160), st.integers(-160, 160)), st.integers(1, 2**32 - 1), max_size=60
    )
)
def test_version_lists(held: dict[TileKey, int]) -> None:
    assert read_versions(pack_versions(held)) == held
