"""Convert published weights that torch cannot read safely to safetensors.

    python scripts/convert_weights.py NAME FILE [-o OUT.safetensors]

NAME is the network in the registry (``megloc weights list``), FILE the published file. Without OUT,
the result is written to the folder of weights, where ``megloc`` finds it.

    aslfeat            model.ckpt-380000.index, or aslfeat.tar: needs tensorflow
    delg-*             the SavedModel's tar.gz, or its variables.index: needs tensorflow
    netvlad-*          the MATLAB struct (.mat)
    apgem-*            the .pt file with its PCA objects
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.io.weights import lookup, weights_folder

Tensors = dict[str, torch.Tensor]
Arrays = Mapping[str, np.ndarray]

# ---------------------------------------------------------------------------------- TensorFlow


def read_tensorflow(path: Path) -> dict[str, np.ndarray]:
    """Read the variables of a TensorFlow checkpoint, or of the one in a tar, by name."""
    if path.suffix == ".index":
        return _read_variables(path.with_suffix(""))
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(path) as archive:
            archive.extractall(folder, filter="data")
        # macOS adds a file ._NAME for each NAME
        found = [p for p in Path(folder).rglob("*.index") if not p.name.startswith("._")]
        if len(found) != 1:
            raise DataError(f"{len(found)} TensorFlow checkpoints (X.index) in it", path=path)
        return _read_variables(found[0].with_suffix(""))


def _read_variables(prefix: Path) -> dict[str, np.ndarray]:
    from tensorflow.train import load_checkpoint  # type: ignore[import-not-found]

    reader = load_checkpoint(str(prefix))
    names = reader.get_variable_to_shape_map()
    arrays = {name: np.asarray(reader.get_tensor(name)) for name in names}
    return {name: array for name, array in arrays.items() if array.dtype.kind in "biuf"}


def torch_layout(values: np.ndarray) -> torch.Tensor:
    """Move the output axis of a kernel or a matrix to the front, as in torch."""
    axes = {4: (3, 2, 0, 1), 2: (1, 0)}.get(values.ndim, range(values.ndim))
    return torch.from_numpy(np.array(values.transpose(axes), order="C"))


# optimiser state: last parts of variable names, per variable and global
OPTIMISER_WORDS = (
    *("Adam", "Adam_1", "Momentum", "RMSProp", "RMSProp_1", "ExponentialMovingAverage"),
    *("global_step", "beta1_power", "beta2_power", "learning_rate"),
)
_TORCH_WORDS = {"kernel": "weight", "moving_mean": "running_mean", "moving_variance": "running_var"}


def aslfeat_state(variables: Arrays) -> Tensors:
    """Return the state dict of AslFeatNet, with dots for slashes and torch's parameter names."""
    state = {}
    for name, values in variables.items():
        scope, _, word = name.rpartition("/")
        if word not in OPTIMISER_WORDS:
            key = f"{scope}/{_TORCH_WORDS.get(word, word)}" if scope else name
            state[key.replace("/", ".")] = torch_layout(values)
    return state


# Three naming schemes of DELG's variables are known; any scope may precede the names.
#   objects   backbone/l2a/conv2a/kernel, backbone/l2a/bn_shortcut/gamma: attributes of the public
#             training code; in an exported model the variables of a block may have numbers
#   layers    res2a_branch2a/kernel, bn2a_branch1/gamma: the same layers in a graph of TF1
#   slim      resnet_v1_50/block1/unit_1/bottleneck_v1/conv1/weights: TF-Slim's ResNet; its layer
#             after the pooling is identified by its shape
_ATTRIBUTE = "/.ATTRIBUTES/VARIABLE_VALUE"
_CONVOLUTION = {"kernel": "weight", "bias": "bias"}
_SLIM_CONVOLUTION = {"weights": "weight", "biases": "bias"}
_NORM = {
    "gamma": "weight",
    "beta": "bias",
    "moving_mean": "running_mean",
    "moving_variance": "running_var",
}
# branch of a block in Keras' names -> torchvision's attributes for convolution and norm
_PARTS = {
    "2a": ("conv1", "bn1"),
    "2b": ("conv2", "bn2"),
    "2c": ("conv3", "bn3"),
    "1": ("downsample.0", "downsample.1"),
}
_STEM = (
    ("conv1", "conv1", _CONVOLUTION),
    ("bn_conv1", "bn1", _NORM),
    ("embedding_layer", "embedding", _CONVOLUTION),
)


def delg_state(variables: Arrays) -> Tensors:
    """Return the state dict of DelgNet; the local branch and the optimiser are left out."""
    variables = {name.removesuffix(_ATTRIBUTE): values for name, values in variables.items()}
    for names in (_keras_names(layers=False), _keras_names(layers=True), _slim_names()):
        keys, state = dict(names), {}
        for name, values in variables.items():
            if "attention/" in name:  # the local branch, which also has a bn_conv1
                continue
            parts = name.split("/")
            scoped = ("/".join(parts[start:]) for start in range(len(parts)))
            key = next((keys[inner] for inner in scoped if inner in keys), None)
            if key in state:
                raise DataError(f"{key} is in it twice, once as {name}")
            if key is not None:
                state[key] = torch_layout(values)
        if "layer1.0.conv1.weight" in state:
            if "embedding.weight" not in state:
                state |= _embedding_by_shape(variables)
            return state
    raise DataError(f"no variables with a known name of DELG's; found: {_first(variables)}")


def _keras_names(*, layers: bool) -> Iterator[tuple[str, str]]:
    """Yield names of scheme ``objects`` or ``layers``, without a scope, and the module's keys."""
    above = "" if layers else "backbone/"
    for layer, key, words in _STEM:
        yield from ((f"{above}{layer}/{word}", f"{key}.{own}") for word, own in words.items())
    for stage, (number, letter) in product(range(1, 5), enumerate(ascii_lowercase)):
        block, place, count = f"{stage + 1}{letter}", f"layer{stage}.{number}", 0
        for branch, keys in _PARTS.items():
            part = "_shortcut" if branch == "1" else branch
            names = f"backbone/l{block}/conv{part}", f"backbone/l{block}/bn{part}"
            if layers:
                names = f"res{block}_branch{branch}", f"bn{block}_branch{branch}"
            for name, key, words in zip(names, keys, (_CONVOLUTION, _NORM), strict=True):
                for word, own in words.items():
                    yield f"{name}/{word}", f"{place}.{key}.{own}"
                    if not layers:
                        yield f"backbone/l{block}/variables/{count}", f"{place}.{key}.{own}"
                    count += 1


def _slim_names() -> Iterator[tuple[str, str]]:
    layers = list(zip(("conv1", "conv2", "conv3", "shortcut"), _PARTS.values(), strict=True))
    places = [("", "", layers[:1])]
    for stage, unit in product(range(1, 5), range(len(ascii_lowercase))):
        scope = f"block{stage}/unit_{unit + 1}/bottleneck_v1/"
        places.append((scope, f"layer{stage}.{unit}.", layers))
    for depth, (scope, place, here) in product((50, 101), places):
        for layer, (convolution, norm) in here:
            name = f"resnet_v1_{depth}/{scope}{layer}"
            for word, own in _SLIM_CONVOLUTION.items():
                yield f"{name}/{word}", f"{place}{convolution}.{own}"
            for word, own in _NORM.items():
                yield f"{name}/BatchNorm/{word}", f"{place}{norm}.{own}"


def _embedding_by_shape(variables: Arrays) -> Tensors:
    """Return the one layer 2048 -> 2048 with a bias, dense or as a 1x1 convolution."""
    found = []
    for name, values in variables.items():
        scope, _, word = name.rpartition("/")
        biases = [variables.get(f"{scope}/{other}") for other in ("biases", "bias")]
        bias = next((b for b in biases if b is not None), None)
        is_square = values.shape in ((2048, 2048), (1, 1, 2048, 2048))
        if word in ("weights", "kernel") and is_square and bias is not None:
            found.append((scope, torch_layout(values.reshape(2048, 2048)), torch_layout(bias)))
    if len(found) != 1:
        scopes = ", ".join(scope for scope, *_ in found) or "none"
        raise DataError(f"one layer of 2048 x 2048 with a bias expected; there is {scopes}")
    return {"embedding.weight": found[0][1], "embedding.bias": found[0][2]}


# -------------------------------------------------------------------------------------- MATLAB

# indices of the convolutions in torchvision's VGG-16
_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


def netvlad_state(path: Path) -> Tensors:
    """Return the tensors of NetVLAD's struct ``net`` under OpenIBL's names.

    Its layers with weights are the 13 convolutions of VGG-16, NetVLAD's layer and the whitening, in
    whose inputs the cluster index runs fastest. ``average_image`` is RGB, 0 to 255.
    """
    from scipy.io import loadmat

    net = loadmat(path, struct_as_record=False, squeeze_me=True)["net"]
    pairs = [layer.weights for layer in net.layers if _has_weights(layer)]
    if len(pairs) != len(_CONVOLUTIONS) + 2:
        raise DataError(f"{len(pairs)} layers of net have weights, not 15", path=path)
    state = {}
    for number, (weight, bias) in zip(_CONVOLUTIONS, pairs, strict=False):
        state[f"base_model.base.{number}.weight"] = torch_layout(weight)
        state[f"base_model.base.{number}.bias"] = _floats(bias)
    (assignment, negated), (whitening, bias) = pairs[-2:]
    state["net_vlad.conv.weight"] = _floats(assignment.T)[:, :, None, None]
    state["net_vlad.centroids"] = -_floats(negated.T)  # the file adds what the paper subtracts
    state["pca_layer.weight"] = _floats(whitening.T)[:, :, None, None]
    state["pca_layer.bias"] = _floats(bias)
    # the authors subtract the first pixel's colour everywhere
    image = net.meta.normalization.averageImage
    state["average_image"] = _floats(image.reshape(-1, 3, order="F")[0])
    return {name: values.float() for name, values in state.items()}


def _has_weights(layer: Any) -> bool:
    return getattr(layer, "weights", np.zeros(0)).size == 2


def _floats(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.array(values, np.float32, order="C"))


# -------------------------------------------------------------------------------------- AP-GeM


class Pca:
    """The attributes of a PCA object of scikit-learn, which need not be installed."""


def apgem_state(path: Path) -> Tensors:
    """Return AP-GeM's state dict and, under additional names, the other data in its file.

    These are ``pca.NAME.{mean,components,explained_variance,whiten}``, ``preprocess.{mean,std}``
    and ``model_options.norm_features``. torch's restricted unpickler may create only numpy arrays
    and the class above, and executes no code in the file.
    """
    core = np._core.multiarray  # type: ignore[attr-defined]
    allowed: list[Any] = [np.ndarray, np.dtype]
    allowed += [type(np.dtype(code)) for code in ("f2", "f4", "f8", "i4", "i8", "u1", "?")]
    for module in ("numpy.core.multiarray", "numpy._core.multiarray"):
        allowed += [(core._reconstruct, f"{module}._reconstruct")]
        allowed += [(core.scalar, f"{module}.scalar")]
    for module in ("sklearn.decomposition.pca", "sklearn.decomposition._pca"):
        allowed.append((Pca, f"{module}.PCA"))
    with torch.serialization.safe_globals(allowed):
        found = torch.load(path, weights_only=True, map_location="cpu")
    options = found.get("model_options", {})
    arch, pooling = options.get("arch", "resnet101_rmac"), options.get("pooling", "gem")
    if arch not in ("resnet50_rmac", "resnet101_rmac") or not pooling.startswith("gem"):
        raise DataError(f"its model_options are not supported: arch={arch} {pooling}", path=path)
    if options.get("center_bias") or options.get("without_fc"):
        raise DataError("its model_options are not supported: center_bias, without_fc", path=path)
    state = {name.removeprefix("module."): value for name, value in found["state_dict"].items()}
    for name, pca in (found.get("pca") or {}).items():
        for part in ("mean", "components", "explained_variance"):
            values = np.asarray(getattr(pca, f"{part}_"))
            native = values.astype(values.dtype.newbyteorder("="))
            state[f"pca.{name}.{part}"] = torch.from_numpy(native)
        state[f"pca.{name}.whiten"] = torch.tensor(bool(pca.whiten))
    for part, values in (found.get("preprocess") or {}).items():
        if part in ("mean", "std"):
            state[f"preprocess.{part}"] = torch.tensor(np.asarray(values))
    state["model_options.norm_features"] = torch.tensor(bool(options.get("norm_features")))
    return state


# ------------------------------------------------------------------------------------------ all


def convert(name: str, path: Path) -> Tensors:
    """Return the tensors of a network's published file, under the keys of our module."""
    method = name.partition("-")[0]
    if method == "aslfeat":
        return aslfeat_state(read_tensorflow(path))
    if method == "delg":
        return delg_state(read_tensorflow(path))
    if method == "netvlad":
        return netvlad_state(path)
    if method == "apgem":
        return apgem_state(path)
    raise OptionError(f"{name}: its files need no conversion; megloc weights add FILE")


def _first(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)[:8])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", help="of the network in the registry")
    parser.add_argument("file", type=Path, help="published file")
    parser.add_argument("-o", "--output", type=Path, help="file to write, .safetensors")
    options = parser.parse_args(arguments)
    try:
        weights = lookup(options.name)
        output = options.output or weights_folder() / weights.converted
        sha256 = hashlib.sha256(options.file.read_bytes()).hexdigest()
        known = {file.sha256 for file in weights.files if options.file.name in file.names} - {None}
        if known and sha256 not in known:
            raise DataError(f"is not the published file: sha256 {sha256}", path=options.file)
        tensors = convert(options.name, options.file)
        output.parent.mkdir(parents=True, exist_ok=True)
        contiguous = {key: value.contiguous().clone() for key, value in tensors.items()}
        save_file(contiguous, output, {"source_sha256": sha256})
    except (MeglocError, OSError, ImportError) as error:
        print(f"convert_weights: {options.file}: {error}", file=sys.stderr)
        return 2
    print(f"{output}: {len(tensors)} tensors")
    return 0


if __name__ == "__main__":
    sys.exit(main())
