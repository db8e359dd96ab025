"""NetVLAD's struct, written by SciPy as MATLAB's, and AP-GeM's objects, which are never made."""

from __future__ import annotations

import io
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from hostile import Runs
from numpy.typing import NDArray
from scipy.io import loadmat, savemat

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights.authors import AVERAGE_IMAGE
from megloc_kapture.io.weights.containers import read_checkpoint

CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
SIZE, CLUSTERS, OUTPUT = 6, 4, 5
MEAN = (123.68, 116.779, 103.939)


def cell(values: list[Any]) -> Any:
    found = np.empty((1, len(values)), object)
    for column, value in enumerate(values):
        found[0, column] = value
    return found


def net(seed: int = 0) -> dict[str, Any]:
    """A small network as MatConvNet keeps it: 13 convolutions, NetVLAD's layer, whitening."""
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> Any:
        return rng.normal(size=shape).astype(np.float32)

    layers: list[dict[str, Any]] = []
    channels = 3
    for number in CONVOLUTIONS:
        while len(layers) < number:
            layers.append({"type": "relu", "name": f"between{len(layers)}"})
        weights = cell([floats(3, 3, channels, SIZE), floats(1, SIZE)])
        layers.append({"type": "conv", "name": f"conv{number}", "weights": weights, "pad": 1.0})
        channels = SIZE
    layers += [{"type": "custom", "name": "preL2"}]
    weights = cell([floats(SIZE, CLUSTERS), floats(SIZE, CLUSTERS)])
    layers.append({"type": "custom", "name": "vlad:core", "weights": weights})
    layers += [{"type": "custom", "name": name} for name in ("intra", "postL2")]
    weights = cell([floats(1, 1, SIZE * CLUSTERS, OUTPUT), floats(1, OUTPUT)])
    layers.append({"type": "conv", "name": "WPCA", "weights": weights})
    layers.append({"type": "custom", "name": "WPCA:L2", "weights": cell([])})
    image = np.tile(np.array(MEAN, np.float32), (4, 4, 1))
    return {
        "layers": cell(layers),
        "meta": {"normalization": {"averageImage": image, "imageSize": [4.0, 4, 3]}},
        "epoch": "best",
    }


def saved(content: dict[str, Any], *, compressed: bool = True) -> bytes:
    out = io.BytesIO()
    savemat(out, {"net": content}, do_compression=compressed, long_field_names=True)
    return out.getvalue()


def read(content: bytes, name: str = "x.mat") -> dict[str, torch.Tensor]:
    def nothing_beside(ending: str) -> bytes:
        raise AssertionError(f"{ending} was asked for")

    return read_checkpoint(content, name, nothing_beside)


@pytest.mark.parametrize("compressed", [False, True])
def test_every_layer_under_its_name_in_torchs_order(compressed: bool) -> None:
    """Against SciPy's reader and the places that hloc takes each layer from."""
    content = saved(net(), compressed=compressed)
    found = read(content)
    file: Any = loadmat(io.BytesIO(content), struct_as_record=False, squeeze_me=True)["net"]
    expected = {}
    for number in CONVOLUTIONS:
        weight, bias = file.layers[number].weights
        expected[f"base_model.base.{number}.weight"] = np.transpose(weight, (3, 2, 0, 1))
        expected[f"base_model.base.{number}.bias"] = bias
    assignment, negated = file.layers[30].weights
    expected["net_vlad.conv.weight"] = assignment.T.reshape(CLUSTERS, SIZE, 1, 1)
    expected["net_vlad.centroids"] = -negated.T
    whitening, bias = file.layers[33].weights
    expected["pca_layer.weight"] = whitening.T.reshape(OUTPUT, SIZE * CLUSTERS, 1, 1)
    expected["pca_layer.bias"] = bias
    expected[AVERAGE_IMAGE] = file.meta.normalization.averageImage[0, 0]
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name].dtype == torch.float32
        np.testing.assert_array_equal(found[name].numpy(), value, err_msg=name)
        found[name] += 1  # the memory is its own
    np.testing.assert_allclose(found[AVERAGE_IMAGE].numpy(), np.add(MEAN, 1), rtol=1e-6)


def test_one_number_of_each_layer_by_hand() -> None:
    content = net()
    first = content["layers"][0, 0]["weights"]
    first[0, 0][2, 1, 0, 3] = 77  # row 2, column 1, red, of output 3
    content["layers"][0, 30]["weights"][0, 0][5, 1] = 78  # dimension 5 of cluster 1
    content["layers"][0, 30]["weights"][0, 1][4, 2] = -79
    content["layers"][0, 33]["weights"][0, 0][0, 0, 7, 3] = 80
    first[0, 1] = np.arange(SIZE, dtype=np.uint8)[None]  # MATLAB stored whole numbers in bytes
    found = read(saved(content))
    assert found["base_model.base.0.weight"][3, 0, 2, 1] == 77
    assert found["net_vlad.conv.weight"][1, 5, 0, 0] == 78
    assert found["net_vlad.centroids"][2, 4] == 79
    assert found["pca_layer.weight"][3, 7, 0, 0] == 80
    bias = found["base_model.base.0.bias"]
    assert bias.dtype == torch.float32 and bias.tolist() == list(range(SIZE))


@pytest.mark.parametrize("image", [np.reshape(MEAN, (1, 1, 3)), np.reshape(MEAN, (1, 3)), None])
def test_the_average_colour_is_that_of_the_first_pixel(image: NDArray[Any] | None) -> None:
    """The authors' code reads one pixel, whatever stands in the others; it may be a colour."""
    content = net()
    normalization = content["meta"]["normalization"]
    if image is None:
        image = normalization["averageImage"]
        image[1:] = image[:, 1:] = 0
    normalization["averageImage"] = image
    np.testing.assert_allclose(read(saved(content))[AVERAGE_IMAGE].numpy(), MEAN, rtol=1e-6)


def test_the_whitening_is_in_memory_once() -> None:
    content, outputs = net(), 100_000
    weights = content["layers"][0, 33]["weights"]
    rng = np.random.default_rng(0)
    weights[0, 0] = rng.random((1, 1, SIZE * CLUSTERS, outputs), dtype=np.float32)
    weights[0, 1] = np.zeros((1, outputs), np.float32)
    file = saved(content)
    tracemalloc.start()
    try:
        found = read(file)
        largest = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found["pca_layer.weight"].is_contiguous()
    # that array, and a few megabytes while it is unpacked
    assert largest < 1.5 * weights[0, 0].nbytes


ONE = np.ones((1, 1))
CONVOLUTION, SQUARE, WHITENING = np.ones((3, 3, SIZE, SIZE)), np.ones((2, 2)), (1, 1, 23, 5)
# where something else stands, None: nothing; of a layer, its weights
REFUSED: dict[str, tuple[tuple[Any, ...], Any, str]] = {
    "no layers": (("layers",), None, "no layers where it should be"),
    "no mean": (("meta", "normalization", "averageImage"), None, "no averageImage where"),
    "no meta": (("meta",), None, "no meta where"),
    "layers no cell": (("layers",), ONE, "net.layers is no cell"),
    "no whitening": (("layers", (0, 33), "weights"), None, "14 layers have weights"),
    "one weight": ((0,), [ONE], r"net\.layers\{1\} has 1 weights"),
    "text": ((0,), ["conv", ONE], r"net\.layers\{1\} is no array of real numbers"),
    "complex": ((0,), [ONE * 1j, ONE], r"layers\{1\} is no array of real numbers"),
    "a cell": ((0,), [cell([ONE]), ONE], r"layers\{1\} is no array of real numbers"),
    "bias": ((2,), [CONVOLUTION, ONE], r"convolution 2 is \(3, 3, 6, 6\)"),
    "centres": ((30,), [ONE, SQUARE], r"layer is \(1, 1\) and \(2, 2\)"),
    "many axes": ((30,), [np.ones((2, 2, 3)), ONE], r"layer is \(2, 2, 3\)"),
    "whitening": ((33,), [np.ones(WHITENING), np.ones((1, 5))], r"is \(23, 5\) after"),
    "gray": (("meta", "normalization", "averageImage"), SQUARE, r"averageImage is \(2, 2\)"),
}


@pytest.mark.parametrize(("where", "value", "message"), REFUSED.values(), ids=REFUSED)
def test_another_structure_is_refused(where: tuple[Any, ...], value: Any, message: str) -> None:
    content = place = net()
    if isinstance(where[0], int):
        where, value = ("layers", (0, where[0]), "weights"), cell(value)
    for key in where[:-1]:
        place = place[key]
    place[where[-1]] = value
    if value is None:
        del place[where[-1]]
    with pytest.raises(DataError, match=rf"^x\.mat: not NetVLAD's struct net: .*13.*{message}"):
        read(saved(content))
    with pytest.raises(DataError, match=r"^x\.mat: not a MAT file"):
        read(b"<!DOCTYPE html>")


# ------------------------------------------------------------------------------------------- AP-GeM

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


def pickled(whitenings: Any, *, legacy: bool = False, **parts: Any) -> bytes:
    out = io.BytesIO()
    state = {"module.fc.weight": torch.arange(6.0).reshape(2, 3), "module.fc.bias": torch.ones(2)}
    content = {"state_dict": state, "model_options": OPTIONS, "preprocess": PREPROCESS}
    content |= {"epoch": 3, "pca": whitenings} | parts
    torch.save(content, out, _use_new_zipfile_serialization=not legacy)
    return out.getvalue()


@pytest.mark.parametrize("legacy", [False, True])
def test_weights_and_arrays(kind: type, legacy: bool) -> None:
    content = pickled({"Landmarks_clean": pca(kind), "b": pca(kind, whiten=False)}, legacy=legacy)
    if legacy:  # written with numpy 1, where the module had another name
        content = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    found = read(content, "x.pt")
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
    content = pickled({"a": pca(kind)}, model_options=None, preprocess=None)
    assert {name.split(".")[0] for name in read(content, "x.pt")} == {"fc", "pca"}
    content = pickled({"a": pca(kind)}, preprocess={"mean": np.array([0.1, 0.2, 0.3])})
    assert read(content, "x.pt")["preprocess.mean"].tolist() == [0.1, 0.2, 0.3]
    normalised = pickled({"a": pca(kind)}, model_options=OPTIONS | {"norm_features": True})
    assert read(normalised, "x.pt")["model_options.norm_features"]


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("where", ["beside", "inside"])
def test_code_is_not_run(kind: type, tmp_path: Path, legacy: bool, where: str) -> None:
    evil = Runs(tmp_path / "made")
    whitenings = {"a": pca(kind, mean_=evil) if where == "inside" else pca(kind)}
    parts = {"optimizer": evil} if where == "beside" else {}
    content = pickled(whitenings, legacy=legacy, **parts)
    with pytest.raises(DataError, match=r"holds objects that are never loaded \(posix\.mkdir\)"):
        read(content, "x.pt")
    assert not (tmp_path / "made").exists()
    torch.load(io.BytesIO(content), weights_only=False)  # it does run where nobody cares
    assert (tmp_path / "made").is_dir()
    other = pickled({"a": pca(kind)}).replace(b"\nPCA\n", b"\nABC\n")
    with pytest.raises(DataError, match=r"never loaded \(sklearn\.decomposition\.\w+\.ABC\)"):
        read(other, "x.pt")


class Objects:
    """An array of objects whose bytes would be pointers, as a pickle can say it."""

    def __reduce__(self) -> tuple[Any, ...]:
        make, arguments, _ = np.zeros(1).__reduce__()
        return make, arguments, (1, (1,), np.dtype("O"), False, b"12345678")


NOT_TAKEN: dict[str, tuple[Callable[[type], Any], str]] = {
    "objects": (lambda kind: {"a": pca(kind, mean_=Objects())}, "pca a mean_ is no array of num"),
    "none": (lambda kind: {"a": pca(kind, components_=None)}, "pca a components_ is no array"),
    "text": (lambda kind: {"a": pca(kind, mean_=np.array(["a"]))}, "pca a mean_ is no array"),
    "complex": (lambda kind: {"a": pca(kind, mean_=np.ones(2, complex))}, "mean_ is no array"),
    "list": (lambda kind: [pca(kind)], "no table of PCA objects"),
    "number": (lambda kind: {"a": pca(kind), "b": 3}, "'b', which is no PCA object"),
    "name": (lambda kind: {"a.b": pca(kind)}, r"'a\.b', which is no PCA object by a name"),
}


@pytest.mark.parametrize(("made", "message"), NOT_TAKEN.values(), ids=NOT_TAKEN)
def test_other_objects_are_refused(kind: type, made: Callable[[type], Any], message: str) -> None:
    with pytest.raises(DataError, match=rf"^x\.pt: its .*{message}"):
        read(pickled(made(kind)), "x.pt")


def test_other_networks_are_refused(kind: type) -> None:
    for changed, message in (
        ({"arch": "fpn"}, "arch='fpn', not one of resnet50_rmac, r"),
        ({"pooling": "max"}, "pooling='max', not gem"),
        ({"center_bias": 0.5}, "center_bias=0.5, not 0"),
        ({"without_fc": True}, "without_fc"),
    ):
        content = pickled({"a": pca(kind)}, model_options=OPTIONS | changed)
        with pytest.raises(DataError, match=f"model_options are not supported: {message}"):
            read(content, "x.pt")
