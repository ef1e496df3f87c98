"""The hash of an ONNX model's weights, read from the file's protobuf directly: the drone carries no onnx package.

The hash is SHA-256 over the raw bytes of the graph's initialisers, in order of name. Field numbers are those of
onnx.proto3: ModelProto.graph 7, GraphProto.initializer 5, TensorProto.float_data 4, int32_data 5, int64_data 7,
name 8, raw_data 9.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

from imagine.core.errors import InputError

_GRAPH, _INITIALIZER = 7, 5
_FLOAT_DATA, _NAME, _RAW_DATA = 4, 8, 9
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def hash_weights(model: bytes, where: str) -> str:
    """Return the SHA-256 of a model's initialisers as hexadecimal digits.

    Raises InputError, naming the model as `where`, if the file cannot be walked or keeps weights in another form.
    """
    weights: dict[str, bytes] = {}
    try:
        for graph in _fields(memoryview(model), _GRAPH):
            for tensor in _fields(graph, _INITIALIZER):
                name = b"".join(bytes(part) for part in _fields(tensor, _NAME)).decode("utf-8")
                raw = list(_fields(tensor, _RAW_DATA)) or list(_fields(tensor, _FLOAT_DATA))
                weights[name] = b"".join(bytes(part) for part in raw)
    except (ValueError, IndexError, UnicodeDecodeError) as error:
        raise InputError(f"{where}: is not a whole ONNX file: {error}") from error
    digest = hashlib.sha256()
    for name in sorted(weights):
        digest.update(weights[name])
    return digest.hexdigest()


def _fields(message: memoryview, wanted: int) -> Iterator[memoryview]:
    """Yield the contents of a message's length-delimited fields of number `wanted`."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            _, at = _varint(message, at)
        elif kind == _FIXED64:
            at += 8
        elif kind == _FIXED32:
            at += 4
        elif kind == _BYTES:
            length, at = _varint(message, at)
            if at + length > len(message):
                raise ValueError(f"a field of {length} bytes runs over the end")
            if number == wanted:
                yield message[at : at + length]
            at += length
        else:
            raise ValueError(f"wire type {kind} is unknown")


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, at
        if shift > 63:
            raise ValueError("a number is too long")
