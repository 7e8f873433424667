"""The layers of an ONNX file, and the file cut off behind one of them.

ONNX files are protocol buffers (onnx.proto3). A model's field 7 is its graph; a graph has its nodes in field 1 and its
outputs in field 12; a node has the names of its inputs in field 1 and of its outputs in field 2. A file that was cut
off works with each version of OpenCV, although their own names of layers differ, and needs less computing.
"""

from collections.abc import Iterator

_GRAPH, _NODE, _OUTPUT = 7, 1, 12
_NAME = 1
_INPUTS, _OUTPUTS = 1, 2
_BYTES = 2  # wire type of fields with a length


def layers(content: bytes) -> tuple[str, ...]:
    """Return the names of the outputs of all nodes, in the order in which they are computed.

    Raises
    ------
    ValueError
        The content is no ONNX file.
    """
    return tuple(name.decode(errors="replace") for node in _nodes(_graph(content)) for name in _named(node, _OUTPUTS))


def cut_behind(content: bytes, layer: str) -> bytes:
    """Return an ONNX file whose only output is that of a layer, without the nodes that it does not need.

    Raises
    ------
    ValueError
        The content is no ONNX file, or has no such layer.
    """
    graph = _graph(content)
    wanted = {layer.encode()}
    kept: set[int] = set()
    nodes = list(_nodes(graph))
    for place in range(len(nodes) - 1, -1, -1):  # an ONNX file has its nodes in the order of computing
        if wanted & set(_named(nodes[place], _OUTPUTS)):
            kept.add(place)
            wanted |= set(_named(nodes[place], _INPUTS))
    if not kept:
        raise ValueError(f"the network has no layer {layer!r}; it has {', '.join(layers(content)[:40])}")
    parts, place = [], 0
    for number, whole, _ in _fields(graph):
        if number == _NODE:
            if place in kept:
                parts.append(whole)
            place += 1
        elif number != _OUTPUT:
            parts.append(whole)
    parts.append(_field(_OUTPUT, _field(_NAME, layer.encode()) + _FLOAT_TENSOR))
    others = [_field(_GRAPH, b"".join(parts)) if number == _GRAPH else whole for number, whole, _ in _fields(content)]
    return b"".join(others)


def _graph(content: bytes) -> bytes:
    for number, _, value in _fields(content):
        if number == _GRAPH:
            return value
    raise ValueError("the file is no ONNX model: it has no graph")


def _nodes(graph: bytes) -> Iterator[bytes]:
    return (value for number, _, value in _fields(graph) if number == _NODE)


def _named(node: bytes, kind: int) -> list[bytes]:
    return [value for number, _, value in _fields(node) if number == kind]


def _fields(content: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield number, all bytes, and the value of each field; the value is empty for a field without a length."""
    at = 0
    while at < len(content):
        begin = at
        key, at = _varint(content, at)
        length = 0
        match key & 7:
            case 0:
                _, at = _varint(content, at)
            case 1:
                at += 8
            case 5:
                at += 4
            case 2:
                length, at = _varint(content, at)
                at += length
            case _:
                raise ValueError("the file is no ONNX model: a field has an unknown kind")
        if at > len(content):
            raise ValueError("the file is no ONNX model: it ends within a field")
        yield key >> 3, content[begin:at], content[at - length : at] if key & 7 == _BYTES else b""


def _varint(content: bytes, at: int) -> tuple[int, int]:
    number = 0
    for shift in range(0, 70, 7):
        if at >= len(content):
            break
        byte = content[at]
        at += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, at
    raise ValueError("the file is no ONNX model: a number has no end")


def _field(number: int, value: bytes) -> bytes:
    return _packed(number << 3 | _BYTES) + _packed(len(value)) + value


def _packed(number: int) -> bytes:
    low, rest = number & 127, number >> 7
    return bytes([low | 128]) + _packed(rest) if rest else bytes([low])


#: The type of an output: float32, with four sides of any length.
_FLOAT_TENSOR = _field(2, _field(1, bytes([1 << 3, 1]) + _field(2, 4 * _field(1, b""))))
