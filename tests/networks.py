"""ONNX files of tiny networks, written without the package onnx."""

import numpy as np
from numpy.typing import NDArray


def varint(number: int) -> bytes:
    low, rest = number & 127, number >> 7
    return bytes([low | 128]) + varint(rest) if rest else bytes([low])


def field(number: int, value: int | bytes) -> bytes:
    """Return a field of a protocol buffer."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def tensor(name: bytes, *sides: int) -> bytes:
    """Return an input or output."""
    shape = b"".join(field(1, field(1, side)) for side in sides)
    return field(1, name) + field(2, field(1, field(1, 1) + field(2, shape)))


def node(sources: list[bytes], target: bytes, kind: bytes, **numbers: int | list[int]) -> bytes:
    """Return a node with attributes of integers."""
    attributes = b"".join(field(5, _attribute(name.encode(), value)) for name, value in numbers.items())
    inputs = b"".join(field(1, source) for source in sources)
    return inputs + field(2, target) + field(3, target) + field(4, kind) + attributes


def weights(name: bytes, values: NDArray[np.float32]) -> bytes:
    """Return an initializer."""
    sides = b"".join(field(1, side) for side in values.shape)
    return sides + field(2, 1) + field(8, name) + field(9, values.astype("<f4").tobytes())


def network(nodes: list[bytes], initializers: list[bytes], output: bytes, length: int) -> bytes:
    """Return a model for images of 224 x 224 pixels that returns one vector."""
    graph = b"".join(field(1, one) for one in nodes) + field(2, b"g")
    graph += b"".join(field(5, one) for one in initializers)
    graph += field(11, tensor(b"x", 1, 3, 224, 224)) + field(12, tensor(output, 1, length))
    return field(1, 8) + field(7, graph) + field(8, field(1, b"") + field(2, 13))


def means_network() -> bytes:
    """Return a model of two nodes that computes the means of the three channels."""
    return network([node([b"x"], b"p", b"GlobalAveragePool"), node([b"p"], b"y", b"Flatten")], [], b"y", 3)


def _attribute(name: bytes, value: int | list[int]) -> bytes:
    if isinstance(value, int):
        return field(1, name) + field(3, value) + field(20, 2)
    return field(1, name) + b"".join(field(8, one) for one in value) + field(20, 7)
