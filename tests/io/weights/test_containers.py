"""Tensors out of every container; nothing of a file is ever run."""

from __future__ import annotations

import io
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from hostile import Runs
from onnx import TensorProto, helper, numpy_helper
from safetensors.torch import save

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.weights.containers import read_checkpoint

BUNDLE = Path(__file__).parent / "data" / "tensor_bundle"
TENSORS = {
    "a.weight": torch.arange(6.0).reshape(2, 3),
    "a.count": torch.tensor(7),
    "b": torch.tensor([1.5, -2.0], dtype=torch.float16),
}


def saved(content: Any, *, legacy: bool = False) -> bytes:
    out = io.BytesIO()
    torch.save(content, out, _use_new_zipfile_serialization=not legacy)
    return out.getvalue()


def nothing_beside(ending: str) -> bytes:
    raise AssertionError(f"{ending} was asked for")


def read(content: bytes, name: str = "x.pth") -> dict[str, torch.Tensor]:
    return read_checkpoint(content, name, nothing_beside)


def npz(**arrays: Any) -> bytes:
    """With a member that is no array, which is left out."""
    out = io.BytesIO()
    np.savez(out, **arrays)
    with zipfile.ZipFile(out, "a") as archive:
        archive.writestr("readme.txt", "read me")
    return out.getvalue()


def onnx_model() -> bytes:
    tensors = [numpy_helper.from_array(value.numpy(), name) for name, value in TENSORS.items()]
    return helper.make_model(
        helper.make_graph([], "graph", [], [], initializer=tensors)
    ).SerializeToString()


def tar(members: dict[str, bytes], mode: str = "w") -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=mode) as archive:
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return out.getvalue()


def bundle(prefix: str = "", stem: str = "graph.ckpt-7") -> dict[str, bytes]:
    endings = (".index", ".data-00000-of-00001")
    return {f"{prefix}{stem}{e}": (BUNDLE / f"{stem}{e}").read_bytes() for e in endings}


CONTAINERS = {
    "torch": ("x.pth", saved(TENSORS)),
    "torch legacy": ("x.pt", saved(TENSORS, legacy=True)),
    "called tar": ("x.pth.tar", saved(TENSORS, legacy=True)),
    "state_dict": ("x.pth", saved({"net": "Net(mchan=6)", "state_dict": TENSORS})),
    "model_state": ("x.pth", saved({"cur_itrs": 3, "model_state": TENSORS})),
    "parallel": ("x.pth", saved({f"module.{name}": value for name, value in TENSORS.items()})),
    "parameters": ("x.pth", saved({**TENSORS, "b": torch.nn.Parameter(TENSORS["b"])})),
    "safetensors": ("x.safetensors", save(TENSORS)),
    "npz": ("x.npz", npz(**{name: value.numpy() for name, value in TENSORS.items()})),
    "onnx": ("x.onnx", onnx_model()),
}


@pytest.mark.parametrize(("name", "content"), CONTAINERS.values(), ids=CONTAINERS)
def test_the_same_out_of_every_container(name: str, content: bytes) -> None:
    found = read(content, name)
    assert found.keys() == TENSORS.keys()
    for key, value in TENSORS.items():
        assert found[key].dtype == value.dtype and not found[key].requires_grad
        assert torch.equal(found[key], value) and found[key].shape == value.shape
        found[key] += 1  # the memory is its own


@pytest.mark.parametrize("mode", ["w", "w:gz"])
def test_tensorflow_in_a_tar(mode: str) -> None:
    members = bundle("model/") | {"model/checkpoint": b"x", "model/._graph.ckpt-7.index": b"mac"}
    found = read(tar(members, mode), "aslfeat.tar")
    assert found["conv0/kernel"][0, 0, 0, 1] == -0.75


def test_tars_without_one_checkpoint() -> None:
    with pytest.raises(DataError, match=r"^x\.tar: 0 TensorFlow checkpoints \(X\.index\) in it"):
        read(tar({"readme": b""}), "x.tar")
    two = bundle("a/") | bundle("b/")
    with pytest.raises(DataError, match="2 TensorFlow .*: a/graph.ckpt-7, b/graph.ckpt-7"):
        read(tar(two), "x.tar")
    half = {name: content for name, content in bundle().items() if name.endswith(".index")}
    with pytest.raises(DataError, match="no graph.ckpt-7.data-00000-of-00001 in it"):
        read(tar(half), "x.tar")
    with pytest.raises(DataError, match="not a tar file that can be read"):
        read(tar(bundle(), "w:gz")[:200], "x.tar")


def test_a_tar_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    read(tar(bundle("../../") | {"/absolute": b""}), "x.tar")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("legacy", [False, True])
def test_code_is_not_run(tmp_path: Path, legacy: bool) -> None:
    content = saved(TENSORS | {"evil": Runs(tmp_path / "made")}, legacy=legacy)
    message = r"holds objects that are never loaded \(posix\.mkdir\).*docs/weights\.md"
    with pytest.raises(DataError, match=message):
        read(content)
    assert not (tmp_path / "made").exists()
    # the same bytes do run where nobody cares
    torch.load(io.BytesIO(content), weights_only=False)
    assert (tmp_path / "made").is_dir()


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("score", [np.float64(0.721), np.float32(0.721), np.int64(3)])
def test_a_score_of_numpy_beside_the_weights(score: Any, legacy: bool) -> None:
    """As DeepLabV3+ is published: ``best_score`` is a numpy scalar."""
    state = {"module.backbone.conv1.weight": torch.ones(2)}
    content = saved({"model_state": state, "best_score": score, "cur_itrs": 30000}, legacy=legacy)
    assert b"multiarray" in content
    assert read(content).keys() == {"backbone.conv1.weight"}
    # written with numpy 1, where the module had another name
    old = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    if legacy:
        assert read(old).keys() == {"backbone.conv1.weight"}
    with pytest.raises(Exception, match="Weights only load failed"):
        torch.load(io.BytesIO(content), weights_only=True)


def test_numpy_bytes_of_a_file_reach_no_code_of_numpy() -> None:
    """A dtype of objects, and bytes that would be a pointer, are dropped like any other score."""

    class Odd:
        def __reduce__(self) -> tuple[Any, ...]:
            return np.dtype, ("O",), (3, "|", None, None, None, -1, -1, 63)

    class Score:
        def __reduce__(self) -> tuple[Any, ...]:
            return np.float64(1).__reduce__()[0], (Odd(), b"12345678")

    assert read(saved({"model_state": TENSORS, "best_score": Score()})).keys() == TENSORS.keys()


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
    found = read(path.read_bytes(), str(path))
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
    found = read(model(tensor), "x.onnx")["t"]
    expected = numpy_helper.to_array(onnx.TensorProto.FromString(tensor.SerializeToString()))
    if kind == TensorProto.BFLOAT16:
        expected = expected.astype(np.float32)
    np.testing.assert_array_equal(found, expected, strict=True)
    np.testing.assert_array_equal(found, values.astype(expected.dtype), strict=True)


def test_scalars_and_empty_tensors() -> None:
    arrays = {"scalar": np.array(2.5, np.float32), "empty": np.zeros((0, 3), np.float32)}
    tensors = [numpy_helper.from_array(array, name) for name, array in arrays.items()]
    for name, found in read(model(*tensors), "x.onnx").items():
        np.testing.assert_array_equal(found, arrays[name], strict=True)


def tensor(**how: Any) -> TensorProto:
    return TensorProto(**({"name": "t", "data_type": TensorProto.FLOAT} | how))


SPARSE = onnx.GraphProto(sparse_initializer=[onnx.SparseTensorProto()])
REFUSED = {
    "empty": ("pth", b"", "no file of weights"),
    "web page": ("pth", b"<!DOCTYPE html><html></html>", "no file of weights"),
    "cut short": ("pth", saved(TENSORS)[:500], "damaged"),
    "cut short legacy": ("pth", saved(TENSORS, legacy=True)[:-20], "damaged"),
    "no tensors": ("pth", saved({"epoch": 3}), "no tensors by name"),
    "a list": ("pth", saved([torch.ones(1)]), "no tensors by name"),
    "twice": ("pth", saved({"a": torch.ones(1), "module.a": torch.ones(1)}), "a is in it twice"),
    "whole module": ("pth", saved(torch.nn.Linear(1, 1)), r"torch\.nn\.modules\.linear\.Linear"),
    "arrays": ("pth", saved({"a": np.ones(2)}), "_reconstruct"),
    "safetensors": ("safetensors", save(TENSORS)[:40], "not a safetensors file"),
    "npz": ("npz", npz(a=np.ones(3))[:60], "not an npz file"),
    "objects in npz": ("npz", npz(a=np.array([{}])), "not an npz file"),
    "text in npz": ("npz", npz(a=np.array(["b"])), "arrays that are no numbers"),
    "no arrays": ("npz", npz(), "no tensors by name"),
    "tensorflow": ("index", b"\x00", "not a checkpoint that can be read"),
    "text": ("onnx", b"this is no model at all", "not an ONNX file"),
    "no graph": ("onnx", onnx.ModelProto(ir_version=8).SerializeToString(), "no graph in it"),
    "strings": ("onnx", model(tensor(data_type=TensorProto.STRING)), "'t' is no array of numbers"),
    "elsewhere": ("onnx", model(tensor(data_location=TensorProto.EXTERNAL)), "in another file"),
    "too few": ("onnx", model(tensor(dims=[3], raw_data=b"1234")), "'t': cannot reshape"),
    "negative": ("onnx", model(tensor(dims=[-1], raw_data=b"1234")), r"'t' of shape \[-1\]"),
    "half a number": ("onnx", model(tensor(dims=[1], raw_data=b"123")), "'t': buffer size"),
    "many dimensions": ("onnx", model(tensor(dims=[1] * 80, raw_data=b"1234")), "dimension"),
    "huge and empty": ("onnx", model(tensor(dims=[1 << 62, 1 << 62, 0])), "not an ONNX file"),
    "two of a name": ("onnx", model(tensor(), tensor(dims=[0])), "'t'"),
    "sparse": ("onnx", helper.make_model(SPARSE).SerializeToString(), "sparse"),
}


@pytest.mark.parametrize(("ending", "content", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(ending: str, content: bytes, message: str) -> None:
    with pytest.raises(DataError, match=message) as error:
        read(content, f"x.{ending}")
    assert str(error.value).startswith(f"x.{ending}: ") and "\n" not in str(error.value)


def test_without_the_package_onnx_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(OptionError, match=r"x\.onnx: .* pip install 'megloc-kapture\[convert\]'"):
        read(onnx_model(), "x.onnx")


def test_what_unpacks_to_far_more_than_it_is_is_refused() -> None:
    """50 kB of each took 6 GB of memory."""
    zeros, packed, compressed = torch.zeros(40_000_000), io.BytesIO(), io.BytesIO()
    np.savez_compressed(compressed, a=zeros.numpy())
    with (
        zipfile.ZipFile(io.BytesIO(saved({"a": zeros}))) as old,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for member in old.infolist():
            new.writestr(member.filename, old.read(member))
    files = {"a.npz": compressed.getvalue(), "a.pth": packed.getvalue()}
    files["a.tar.gz"] = tar({"a.index": zeros.numpy().tobytes()}, "w:gz")
    for name, content in files.items():
        with pytest.raises(DataError, match=f"{name}: .* bytes that unpack to 160"):
            read(content, name)
