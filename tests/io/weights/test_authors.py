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
from megloc_kapture.io.weights import convert_weights, describe, read_weights
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
    found = read(saved(content))
    assert found["base_model.base.0.weight"][3, 0, 2, 1] == 77
    assert found["net_vlad.conv.weight"][1, 5, 0, 0] == 78
    assert found["net_vlad.centroids"][2, 4] == 79
    assert found["pca_layer.weight"][3, 7, 0, 0] == 80


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 3)])
def test_an_average_colour_instead_of_an_image(shape: tuple[int, ...]) -> None:
    content = net()
    content["meta"]["normalization"]["averageImage"] = np.reshape(MEAN, shape)
    np.testing.assert_allclose(read(saved(content))[AVERAGE_IMAGE].numpy(), MEAN, rtol=1e-6)


def test_the_colour_is_that_of_the_first_pixel() -> None:
    """The authors' code reads one pixel, whatever stands in the others."""
    content = net()
    image = content["meta"]["normalization"]["averageImage"]
    image[1:] = image[:, 1:] = 0
    np.testing.assert_allclose(read(saved(content))[AVERAGE_IMAGE].numpy(), MEAN, rtol=1e-6)


def test_whole_numbers_that_matlab_stored_in_bytes() -> None:
    content = net()
    content["layers"][0, 0]["weights"][0, 1] = np.arange(SIZE, dtype=np.uint8)[None]
    found = read(saved(content))["base_model.base.0.bias"]
    assert found.dtype == torch.float32 and found.tolist() == list(range(SIZE))


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


def without(*path: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        place: Any = content
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return change


def with_weights(layer: int, *weights: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["layers"][0, layer]["weights"] = cell(list(weights))

    return change


def with_image(image: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["meta"]["normalization"]["averageImage"] = image

    return change


ONE = np.ones((1, 1))
REFUSED: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "no layers": (without("layers"), "no layers where it should be"),
    "no mean": (without("meta", "normalization", "averageImage"), "no averageImage where"),
    "no meta": (without("meta"), "no meta where"),
    "layers no cell": (lambda c: c.update(layers=ONE), "net.layers is no cell"),
    "no whitening": (without(*("layers", (0, 33)), "weights"), "14 layers have weights"),
    "one weight": (with_weights(0, ONE), r"net\.layers\{1\} has 1 weights"),
    "text": (with_weights(0, "conv", ONE), r"net\.layers\{1\} is no array of real numbers"),
    "complex": (with_weights(0, ONE * 1j, ONE), r"layers\{1\} is no array of real numbers"),
    "a cell": (with_weights(0, cell([ONE]), ONE), r"layers\{1\} is no array of real numbers"),
    "bias": (with_weights(2, np.ones((3, 3, SIZE, SIZE)), ONE), r"convolution 2 is \(3, 3, 6, 6\)"),
    "centres": (with_weights(30, ONE, np.ones((2, 2))), r"layer is \(1, 1\) and \(2, 2\)"),
    "many axes": (with_weights(30, np.ones((2, 2, 3)), ONE), r"layer is \(2, 2, 3\)"),
    "whitening": (with_weights(33, np.ones((1, 1, 23, 5)), np.ones((1, 5))), r"is \(23, 5\) after"),
    "gray mean": (with_image(np.ones((4, 4))), r"averageImage is \(4, 4\)"),
}


@pytest.mark.parametrize(("change", "message"), REFUSED.values(), ids=REFUSED)
def test_another_structure_is_refused(
    change: Callable[[dict[str, Any]], None], message: str
) -> None:
    content = net()
    change(content)
    with pytest.raises(DataError, match=rf"^x\.mat: not NetVLAD's struct net: .*13.*{message}"):
        read(saved(content))


def test_other_files_are_refused() -> None:
    out = io.BytesIO()
    savemat(out, {"vlad": np.ones(3)})
    with pytest.raises(DataError, match=r"^x\.mat: not NetVLAD's struct net: .*no layers where"):
        read(out.getvalue())
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


def read_apgem(content: bytes) -> dict[str, torch.Tensor]:
    return read(content, "x.pt")


@pytest.mark.parametrize("legacy", [False, True])
def test_weights_and_arrays(kind: type, legacy: bool) -> None:
    content = pickled({"Landmarks_clean": pca(kind), "b": pca(kind, whiten=False)}, legacy=legacy)
    if legacy:  # written with numpy 1, where the module had another name
        content = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    found = read_apgem(content)
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
    assert {name.split(".")[0] for name in read_apgem(content)} == {"fc", "pca"}
    content = pickled({"a": pca(kind)}, preprocess={"mean": np.array([0.1, 0.2, 0.3])})
    assert read_apgem(content)["preprocess.mean"].tolist() == [0.1, 0.2, 0.3]
    normalised = pickled({"a": pca(kind)}, model_options=OPTIONS | {"norm_features": True})
    assert read_apgem(normalised)["model_options.norm_features"]


def test_converted_it_is_the_same(kind: type, tmp_path: Path) -> None:
    source, place = tmp_path / "x.pt", tmp_path / "x.safetensors"
    source.write_bytes(pickled({"Landmarks_clean": pca(kind)}))
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
    content = pickled(whitenings, legacy=legacy, **parts)
    with pytest.raises(DataError, match=r"holds objects that are never loaded \(posix\.mkdir\)"):
        read_apgem(content)
    assert not (tmp_path / "made").exists()
    torch.load(io.BytesIO(content), weights_only=False)  # it does run where nobody cares
    assert (tmp_path / "made").is_dir()


def test_other_classes_of_the_library_are_refused(kind: type) -> None:
    content = pickled({"a": pca(kind)}).replace(b"\nPCA\n", b"\nABC\n")
    with pytest.raises(DataError, match=r"never loaded \(sklearn\.decomposition\.\w+\.ABC\)"):
        read_apgem(content)


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
        read_apgem(pickled({"a": pca(kind, **attributes)}))


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
        read_apgem(pickled({"a": pca(kind)}, model_options=OPTIONS | changed))


def test_tables_of_other_things_are_refused(kind: type) -> None:
    with pytest.raises(DataError, match="no table of PCA objects"):
        read_apgem(pickled([pca(kind)]))
    with pytest.raises(DataError, match="'b', which is no PCA object"):
        read_apgem(pickled({"a": pca(kind), "b": 3}))
    with pytest.raises(DataError, match=r"'a\.b', which is no PCA object by a name"):
        read_apgem(pickled({"a.b": pca(kind)}))
