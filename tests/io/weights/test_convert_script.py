"""scripts/convert_weights.py on files of the published kinds."""

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
from convert_weights import apgem_state, main, netvlad_state
from numpy.typing import NDArray
from scipy.io import loadmat, savemat

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import MissingWeightsError, add_weights, find_weights, read_weights

CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
SIZE, CLUSTERS, OUTPUT = 6, 4, 5
MEAN = (123.68, 116.779, 103.939)
OPTIONS = {"arch": "resnet101_rmac", "out_dim": 2048, "pooling": "gem", "gemp": 3}
PREPROCESS = {"mean": [0.485, 0.456, 0.406], "std": (0.229, 0.224, 0.225), "input_size": 224}


def cell(values: list[Any]) -> Any:
    row = np.empty((1, len(values)), object)
    for column, value in enumerate(values):
        row[0, column] = value
    return row


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


def test_layers_of_netvlad_are_renamed_and_transposed_for_torch(tmp_path: Path) -> None:
    """hloc takes each layer from the same positions."""
    path = tmp_path / "Pitts30K_struct.mat"
    savemat(path, {"net": net()}, long_field_names=True)
    actual = netvlad_state(path)
    file: Any = loadmat(path, struct_as_record=False, squeeze_me=True)["net"]
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
    expected["average_image"] = np.array(MEAN, np.float32)
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        assert actual[name].dtype == torch.float32
        np.testing.assert_array_equal(actual[name].numpy(), value, err_msg=name)


@pytest.fixture
def kind(monkeypatch: pytest.MonkeyPatch) -> Iterator[type]:
    """A class that is pickled under scikit-learn's name."""
    module = "sklearn.decomposition.pca"
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


def pickled(path: Path, whitenings: Any, *, legacy: bool = False, **parts: Any) -> Path:
    out = io.BytesIO()
    state = {"module.fc.weight": torch.arange(6.0).reshape(2, 3), "module.fc.bias": torch.ones(2)}
    content = {"state_dict": state, "model_options": OPTIONS, "preprocess": PREPROCESS}
    content |= {"epoch": 3, "pca": whitenings} | parts
    torch.save(content, out, _use_new_zipfile_serialization=not legacy)
    written = out.getvalue()
    if legacy:  # with numpy 1, where the module had another name
        written = written.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    path.write_bytes(written)
    return path


@pytest.mark.parametrize("legacy", [False, True])
def test_arrays_of_apgem_are_kept(kind: type, legacy: bool, tmp_path: Path) -> None:
    whitenings = {"Landmarks_clean": pca(kind), "b": pca(kind, whiten=False)}
    actual = apgem_state(pickled(tmp_path / "x.pt", whitenings, legacy=legacy))
    for part, values in arrays().items():
        tensor = actual[f"pca.Landmarks_clean.{part.removesuffix('_')}"]
        np.testing.assert_array_equal(tensor.numpy(), values)
    assert actual["pca.Landmarks_clean.whiten"] and not actual["pca.b.whiten"]
    assert actual["preprocess.mean"].tolist() == PREPROCESS["mean"]
    assert actual["preprocess.std"].tolist() == list(PREPROCESS["std"])
    assert not actual["model_options.norm_features"] and len(actual) == 13
    other = pickled(tmp_path / "x.pt", {}, model_options=OPTIONS | {"arch": "fpn"})
    with pytest.raises(DataError, match="model_options are not supported: arch=fpn"):
        apgem_state(other)


def test_code_in_a_checkpoint_is_not_run(kind: type, code: object, tmp_path: Path) -> None:
    whitenings = {"a": pca(kind, mean_=code)}
    path = pickled(tmp_path / "Resnet-101-AP-GeM.pt", whitenings, legacy=True)
    with pytest.raises(Exception, match="mkdir"):
        apgem_state(path)
    assert not (tmp_path / "made").exists()


def test_the_script_writes_to_the_folder_of_weights(
    kind: type, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    folder = tmp_path / "weights"
    folder.mkdir()
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(folder))
    path = pickled(folder / "Resnet-101-AP-GeM.pt", {"Landmarks_clean": pca(kind)})
    command = f"python scripts/convert_weights.py apgem-resnet101 {path}"
    with pytest.raises(MissingWeightsError, match=f"must be converted once: {command}$"):
        find_weights("apgem-resnet101")
    with pytest.raises(DataError, match=f"convert it once: {command}$"):
        add_weights(path)
    assert main(["apgem-resnet101", str(path)]) == 0
    assert capsys.readouterr().out == f"{folder}/apgem-resnet101.safetensors: 9 tensors\n"
    assert "pca.Landmarks_clean.mean" in read_weights(find_weights("apgem-resnet101"))
    assert main(["apgem", str(path)]) == 2
    assert "no weights 'apgem' in the registry" in capsys.readouterr().err
    mat = tmp_path / "Pitts30K_struct.mat"
    mat.write_bytes(b"another file")
    assert main(["netvlad-pitts30k", str(mat)]) == 2
    assert "is not the published file" in capsys.readouterr().err
