"""Checkpoints that hold scikit-learn's PCA: arrays come out, nothing of the file is run."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from hostile import Runs
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import convert_weights, describe, read_weights
from megloc_kapture.io.weights.containers import read_checkpoint

OPTIONS = {"arch": "resnet101_rmac", "out_dim": 2048, "pooling": "gem", "gemp": 3}
PREPROCESS = {"mean": [0.485, 0.456, 0.406], "std": (0.229, 0.224, 0.225), "input_size": 224}


@pytest.fixture(params=["sklearn.decomposition.pca", "sklearn.decomposition._pca"])
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[type]:
    """A class that is pickled under scikit-learn's name."""
    module = request.param
    made = type("PCA", (), {"__module__": module})
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        name = ".".join(parts[:count])
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(sys.modules[module], "PCA", made, raising=False)
    yield made


def arrays(seed: int = 0) -> dict[str, NDArray[Any]]:
    random = np.random.default_rng(seed)
    return {
        "mean_": random.normal(size=7).astype(np.float32),
        "components_": np.asfortranarray(random.normal(size=(5, 7))),
        "explained_variance_": random.uniform(size=5).astype(">f4"),
    }


def pca(kind: type, **attributes: Any) -> Any:
    made = kind()
    made.__dict__ |= arrays() | {"whiten": True, "n_components": None, "svd_solver": "full"}
    made.__dict__ |= {"noise_variance_": np.float64(0.25), "n_samples_": 5, "copy": True}
    made.__dict__ |= {"_sklearn_version": "0.20.2"} | attributes
    return made


def saved(whitenings: Any, *, legacy: bool = False, **parts: Any) -> bytes:
    out = io.BytesIO()
    state = {"module.fc.weight": torch.arange(6.0).reshape(2, 3), "module.fc.bias": torch.ones(2)}
    content = {"state_dict": state, "model_options": OPTIONS, "preprocess": PREPROCESS}
    content |= {"epoch": 3, "pca": whitenings} | parts
    torch.save(content, out, _use_new_zipfile_serialization=not legacy)
    return out.getvalue()


def read(content: bytes) -> dict[str, torch.Tensor]:
    def nothing(ending: str) -> bytes:
        raise AssertionError(ending)

    return read_checkpoint(content, "x.pt", nothing)


@pytest.mark.parametrize("legacy", [False, True])
def test_weights_and_arrays(kind: type, legacy: bool) -> None:
    content = saved({"Landmarks_clean": pca(kind), "b": pca(kind, whiten=False)}, legacy=legacy)
    if legacy:  # written with numpy 1, where the module had another name
        content = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    found = read(content)
    names = [f"pca.{n}.{part}" for n in ("Landmarks_clean", "b") for part in
             ("mean", "components", "explained_variance", "whiten")]  # fmt: skip
    others = ["preprocess.mean", "preprocess.std", "model_options.norm_features"]
    assert set(found) == {"fc.weight", "fc.bias", *names, *others}
    for part, values in arrays().items():
        tensor = found[f"pca.Landmarks_clean.{part.removesuffix('_')}"]
        np.testing.assert_array_equal(tensor.numpy(), values)
        assert tensor.dtype == {4: torch.float32, 8: torch.float64}[values.dtype.itemsize]
    assert found["pca.Landmarks_clean.whiten"] and not found["pca.b.whiten"]
    assert found["preprocess.mean"].tolist() == PREPROCESS["mean"]
    assert found["preprocess.std"].tolist() == list(PREPROCESS["std"])
    assert not found["model_options.norm_features"]
    for tensor in found.values():
        tensor.add_(1) if tensor.dtype != torch.bool else None  # the memory is its own


def test_options_and_statistics_may_be_missing(kind: type) -> None:
    content = saved({"a": pca(kind)}, model_options=None, preprocess=None)
    assert {name.split(".")[0] for name in read(content)} == {"fc", "pca"}
    content = saved({"a": pca(kind)}, preprocess={"mean": np.array([0.1, 0.2, 0.3])})
    assert read(content)["preprocess.mean"].tolist() == [0.1, 0.2, 0.3]
    normalised = saved({"a": pca(kind)}, model_options=OPTIONS | {"norm_features": True})
    assert read(normalised)["model_options.norm_features"]


def test_converted_it_is_the_same(kind: type, tmp_path: Path) -> None:
    source, place = tmp_path / "x.pt", tmp_path / "x.safetensors"
    source.write_bytes(saved({"Landmarks_clean": pca(kind)}))
    convert_weights(source, place)
    before, after = (read_weights(describe(p.name, p)) for p in (source, place))
    assert before.keys() == after.keys() and "pca.Landmarks_clean.components" in after
    assert all(torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("where", ["beside", "inside"])
def test_code_is_not_run(kind: type, tmp_path: Path, legacy: bool, where: str) -> None:
    evil = Runs(tmp_path / "made")
    whitenings = {"a": pca(kind, mean_=evil) if where == "inside" else pca(kind)}
    parts = {"optimizer": evil} if where == "beside" else {}
    content = saved(whitenings, legacy=legacy, **parts)
    with pytest.raises(DataError, match=r"holds objects that are never loaded \(posix\.mkdir\)"):
        read(content)
    assert not (tmp_path / "made").exists()
    torch.load(io.BytesIO(content), weights_only=False)  # it does run where nobody cares
    assert (tmp_path / "made").is_dir()


def test_other_classes_of_the_library_are_refused(kind: type) -> None:
    content = saved({"a": pca(kind)}).replace(b"\nPCA\n", b"\nABC\n")
    with pytest.raises(DataError, match=r"never loaded \(sklearn\.decomposition\.\w+\.ABC\)"):
        read(content)


class Objects:
    """An array of objects whose bytes would be pointers, as a pickle can say it."""

    def __reduce__(self) -> tuple[Any, ...]:
        make, arguments, _ = np.zeros(1).__reduce__()
        return make, arguments, (1, (1,), np.dtype("O"), False, b"12345678")


WRONG = {
    "objects": ({"mean_": Objects()}, "pca a mean_ is no array of numbers"),
    "none": ({"components_": None}, "pca a components_ is no array of numbers"),
    "text": ({"mean_": np.array(["a"])}, "pca a mean_ is no array of numbers"),
    "complex": ({"mean_": np.ones(2, complex)}, "pca a mean_ is no array of numbers"),
}


@pytest.mark.parametrize(("attributes", "message"), WRONG.values(), ids=WRONG)
def test_arrays_of_other_things(kind: type, attributes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=rf"^x\.pt: its {message}"):
        read(saved({"a": pca(kind, **attributes)}))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"arch": "resnet101_fpn_rmac"}, "arch='resnet101_fpn_rmac', not one of resnet50_rmac, r"),
        ({"pooling": "max"}, "pooling='max', not gem"),
        ({"center_bias": 0.5}, "center_bias=0.5, not 0"),
        ({"without_fc": True}, "without_fc"),
    ],
    ids=str,
)
def test_other_networks_are_refused(kind: type, changed: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=f"model_options are not supported: {message}"):
        read(saved({"a": pca(kind)}, model_options=OPTIONS | changed))


def test_tables_of_other_things_are_refused(kind: type) -> None:
    with pytest.raises(DataError, match="no table of PCA objects"):
        read(saved([pca(kind)]))
    with pytest.raises(DataError, match="'b', which is no PCA object"):
        read(saved({"a": pca(kind), "b": 3}))
    with pytest.raises(DataError, match=r"'a\.b', which is no PCA object by a name"):
        read(saved({"a.b": pca(kind)}))
