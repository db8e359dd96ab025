"""Every container of weights, read safely; what is none of them, or would run code, is refused."""

from __future__ import annotations

import io
import os
import tarfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from onnx import helper, numpy_helper
from safetensors.torch import save

from megloc_kapture.errors import DataError
from megloc_kapture.io.checkpoints import read_checkpoint

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
    out = io.BytesIO()
    np.savez(out, **arrays)
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


def test_tensorflow() -> None:
    files = bundle()

    def beside(ending: str) -> bytes:
        return files[f"graph.ckpt-7{ending}"]

    found = read_checkpoint(files["graph.ckpt-7.index"], "graph.ckpt-7.index", beside)
    assert found["conv0/kernel"].shape == (3, 3, 1, 2)
    assert found["tower/conv1/instance_max"] == 3.25


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


class Runs:
    """Pickled as a call; unpickled by pickle itself it makes a folder."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self.place),)


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


REFUSED = {
    "empty": (b"", "x.pth", "no file of weights"),
    "web page": (b"<!DOCTYPE html><html></html>", "x.pth", "no file of weights"),
    "cut short": (saved(TENSORS)[:500], "x.pth", "damaged"),
    "cut short legacy": (saved(TENSORS, legacy=True)[:-20], "x.pth", "damaged"),
    "no tensors": (saved({"epoch": 3}), "x.pth", "no tensors by name"),
    "a list": (saved([torch.ones(1)]), "x.pth", "no tensors by name"),
    "one tensor": (saved(torch.ones(1)), "x.pth", "no tensors by name"),
    "twice": (saved({"a": torch.ones(1), "module.a": torch.ones(1)}), "x.pth", "a is in it twice"),
    "whole module": (saved(torch.nn.Linear(1, 1)), "x.pth", r"torch\.nn\.modules\.linear\.Linear"),
    "arrays": (saved({"a": np.ones(2)}), "x.pth", "_reconstruct"),
    "safetensors": (save(TENSORS)[:40], "x.safetensors", "not a safetensors file"),
    "npz": (npz(a=np.ones(3))[:60], "x.npz", "not an npz file"),
    "objects in npz": (npz(a=np.array([{}])), "x.npz", "not an npz file"),
    "text in npz": (npz(a=np.array(["b"])), "x.npz", "arrays that are no numbers"),
    "no arrays": (npz(), "x.npz", "no tensors by name"),
    "onnx": (b"\x00", "x.onnx", "not an ONNX file"),
    "tensorflow": (b"\x00", "x.index", "not a checkpoint that can be read"),
}


@pytest.mark.parametrize(("content", "name", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(content: bytes, name: str, message: str) -> None:
    with pytest.raises(DataError, match=message) as error:
        read(content, name)
    assert str(error.value).startswith(f"{name}: ") and "\n" not in str(error.value)


@given(st.data(), st.sampled_from(sorted(CONTAINERS)))
def test_mutations_give_data_errors(data: st.DataObject, kind: str) -> None:
    name, whole = CONTAINERS[kind]
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(content)))
    for broken in (bytes(content), bytes(content[:cut])):
        with suppress(DataError):
            read(broken, name)
