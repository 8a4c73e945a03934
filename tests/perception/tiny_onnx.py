"""ONNX files of a few bytes, written field by field (protobuf): any wrong network, without the onnx package."""

from collections.abc import Sequence

FLOAT, INT64 = 1, 7
Shape = Sequence[int | str]


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _field(number: int, value: int | bytes | str) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _value(name: str, shape: Shape, kind: int) -> bytes:
    """ValueInfoProto of a tensor; a dimension is a number or a name."""
    dims = b"".join(_field(1, _field(1, d) if isinstance(d, int) else _field(2, d)) for d in shape)
    tensor = _field(1, kind) + _field(2, dims)
    return _field(1, name) + _field(2, _field(1, tensor))


def node(operator: str, inputs: Sequence[str], outputs: Sequence[str], **attributes: int | list[int]) -> bytes:
    """NodeProto with whole numbers or lists of them as attributes."""
    data = b"".join(_field(1, name) for name in inputs) + b"".join(_field(2, name) for name in outputs)
    data += _field(4, operator)
    for name, value in attributes.items():
        if isinstance(value, int):
            data += _field(5, _field(1, name) + _field(3, value) + _field(20, 2))
        else:
            data += _field(5, _field(1, name) + b"".join(_field(8, item) for item in value) + _field(20, 7))
    return data


def network(
    nodes: Sequence[bytes],
    *,
    inputs: Sequence[tuple[str, Shape]] = (("images", (1, 3, "h", "w")),),
    output: Shape = (1, 21, "H", "W"),
    kind: int = FLOAT,
) -> bytes:
    """ModelProto whose last result is named "out"."""
    graph = b"".join(_field(1, item) for item in nodes) + _field(2, "tiny")
    graph += b"".join(_field(11, _value(name, shape, kind)) for name, shape in inputs)
    graph += _field(12, _value("out", output, kind))
    return _field(1, 8) + _field(7, graph) + _field(8, _field(1, "") + _field(2, 13))


SEVEN_TIMES = node("Concat", ["images"] * 7, ["classes"], axis=1)  # three channels become VOC's twenty-one classes
