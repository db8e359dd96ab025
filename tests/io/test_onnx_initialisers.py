"""Initialisers of ONNX files, against the package onnx."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from megloc_kapture.errors import DataError
from megloc_kapture.io.onnx_initialisers import read_initialisers

KINDS = {
    name: getattr(TensorProto, name)
    for name in ("FLOAT", "UINT8", "INT8", "UINT16", "INT16", "INT32", "INT64", "BOOL")
    + ("FLOAT16", "DOUBLE", "UINT32", "UINT64", "BFLOAT16")
}


def model(*tensors: TensorProto) -> bytes:
    graph = helper.make_graph([], "graph", [], [], initializer=list(tensors))
    return helper.make_model(graph).SerializeToString()


def values_of(kind: int) -> np.ndarray[Any, Any]:
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    ends: list[Any] = [0, 1]
    if np.issubdtype(dtype, np.integer):
        ends += [np.iinfo(dtype).min, np.iinfo(dtype).max]
    elif kind != TensorProto.BOOL:
        ends += [-1.5, 0.0078125]
    return np.array([ends, ends[::-1]], dtype)


@pytest.mark.parametrize("file", ["xfeat/xfeat.onnx", "lighterglue/lighterglue_L3.onnx"])
def test_published_files(shared_data: Path, file: str) -> None:
    path = shared_data / "weights" / file
    if not path.is_file():
        pytest.skip(f"no {path}")
    truth = onnx.load(path).graph.initializer
    found = read_initialisers(path.read_bytes(), str(path))
    assert list(found) == [tensor.name for tensor in truth]
    for tensor in truth:
        expected = numpy_helper.to_array(tensor)
        np.testing.assert_array_equal(found[tensor.name], expected, strict=True)


@pytest.mark.parametrize("raw", [True, False], ids=["raw", "typed"])
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_every_kind_of_number(kind: int, raw: bool) -> None:
    values = values_of(kind)
    content = values.tobytes() if raw else values.ravel().tolist()
    tensor = helper.make_tensor("t", kind, values.shape, content, raw=raw)
    found = read_initialisers(model(tensor), "x.onnx")["t"]
    expected = numpy_helper.to_array(onnx.TensorProto.FromString(tensor.SerializeToString()))
    if kind == TensorProto.BFLOAT16:
        expected = expected.astype(np.float32)
    np.testing.assert_array_equal(found, expected, strict=True)
    np.testing.assert_array_equal(found, values.astype(expected.dtype), strict=True)


def test_scalars_and_empty_tensors() -> None:
    scalar = numpy_helper.from_array(np.float32(2.5), "scalar")
    empty = numpy_helper.from_array(np.zeros((0, 3), np.float32), "empty")
    found = read_initialisers(model(scalar, empty), "x.onnx")
    assert found["scalar"].shape == () and found["scalar"] == 2.5
    assert found["empty"].shape == (0, 3)


def tensor(**how: Any) -> TensorProto:
    return TensorProto(**({"name": "t", "data_type": TensorProto.FLOAT} | how))


BROKEN = {
    "text": (b"this is no model at all", "not an ONNX file"),
    "no graph": (onnx.ModelProto(ir_version=8).SerializeToString(), "no graph in it"),
    "strings": (model(tensor(data_type=TensorProto.STRING)), "'t' has data type 8"),
    "elsewhere": (model(tensor(data_location=TensorProto.EXTERNAL)), "'t' lie in another file"),
    "too few": (model(tensor(dims=[3], raw_data=b"1234")), r"shape \[3\] has 1 values"),
    "negative": (model(tensor(dims=[-1], raw_data=b"1234")), r"shape \[-1\] has 1 values"),
    "half a number": (model(tensor(dims=[1], raw_data=b"123")), "'t' has 3 bytes"),
    "many dimensions": (model(tensor(dims=[1] * 80, raw_data=b"1234")), "dimension"),
    "huge and empty": (model(tensor(dims=[1 << 62, 1 << 62, 0])), "not an ONNX file"),
    "twice": (model(tensor(), tensor(dims=[0])), "'t'"),
    "does not fit": (
        model(tensor(data_type=TensorProto.INT8, dims=[1], int32_data=[300])),
        "does not fit",
    ),
    "sparse": (
        helper.make_model(
            onnx.GraphProto(sparse_initializer=[onnx.SparseTensorProto()])
        ).SerializeToString(),
        "sparse",
    ),
}


@pytest.mark.parametrize(("content", "message"), BROKEN.values(), ids=BROKEN)
def test_what_is_wrong_is_named(content: bytes, message: str) -> None:
    with pytest.raises(DataError, match=rf"^x\.onnx: .*{message}"):
        read_initialisers(content, "x.onnx")


WHOLE = model(
    *(
        helper.make_tensor(f"t{kind}{raw}", kind, (2, 2), v.tobytes() if raw else v.ravel(), raw)
        for kind in (TensorProto.FLOAT, TensorProto.INT64, TensorProto.FLOAT16, TensorProto.UINT8)
        for raw in (True, False)
        for v in [values_of(kind)[:, :2]]
    )
)


@given(st.data())
def test_mutations_give_data_errors(data: st.DataObject) -> None:
    content = bytearray(WHOLE)
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(content) - 1))
        match data.draw(st.sampled_from(("change", "remove", "insert"))):
            case "change":
                content[at] = data.draw(st.integers(0, 255))
            case "remove" if len(content) > 1:
                del content[at]
            case _:
                content.insert(at, data.draw(st.integers(0, 255)))
    with suppress(DataError):
        read_initialisers(bytes(content), "x.onnx")


@given(st.binary(max_size=200))
def test_any_bytes_give_data_errors(content: bytes) -> None:
    # as a file, as a graph of one, and as an initialiser of that
    graph = b"\x3a" + bytes([len(content) & 0x7F]) + content[:127]
    inner = b"\x2a" + bytes([len(content[:100])]) + content[:100]
    initialiser = b"\x3a" + bytes([len(inner)]) + inner
    for whole in (content, graph, initialiser):
        with suppress(DataError):
            read_initialisers(whole, "x.onnx")


def test_bfloat16_is_exact() -> None:
    values = np.array([1.5, -2.25, 3e38, 1e-38], ml_dtypes.bfloat16)
    made = helper.make_tensor("t", TensorProto.BFLOAT16, (4,), values.tobytes(), raw=True)
    found = read_initialisers(model(made), "x.onnx")["t"]
    np.testing.assert_array_equal(found, values.astype(np.float32), strict=True)
