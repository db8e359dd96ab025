"""Random weights for the preset ``megloc`` in the containers that its networks are published in.

    .venv/bin/python benchmarks/whole_preset_weights.py DIR
    MEGLOC_WEIGHTS=DIR make eval DATASET=synthetic-aachen PRESET=megloc

Every file has the official name, container, keys and shapes; the numbers are drawn from a seed.
Where torch's own way to begin a network would let nothing through (a score map that is flat, a
graph that drowns the descriptors), the numbers are scaled so that features still answer to texture
and matches to descriptors: then every stage after them has something to do.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.io import savemat
from tensorflow_checkpoints import write_saved_model, write_tensorflow_checkpoint
from torch import nn

from megloc_kapture.features.aslfeat import AslFeatNet
from megloc_kapture.features.superpoint import SuperPointNet
from megloc_kapture.io.weights import UNVERIFIED, registry
from megloc_kapture.nets.delg import DelgNet
from megloc_kapture.nets.global_descriptors import ApGemNet, VggNetVlad
from megloc_kapture.nets.lpips import Lpips
from megloc_kapture.nets.superglue import SuperGlueNet
from megloc_kapture.preprocessing.deeplab import DeepLabV3Plus

_PCA_MODULE = "sklearn.decomposition.pca"
_MEAN_RGB = (123.68, 116.779, 103.939)
_STANDING_CLASSES = 11  # of Cityscapes, before person, rider and the vehicles
# how sharply SuperGlue tells similar descriptors apart, and the cosine that the dustbin has
_SHARPNESS, _DUSTBIN_COSINE = 30.0, 0.6
_TENSORFLOW_WORDS = {
    "weight": "kernel",
    "bias": "bias",
    "running_mean": "moving_mean",
    "running_var": "moving_variance",
}
_SLIM_NORMS = {
    "weight": "gamma",
    "bias": "beta",
    "running_mean": "moving_mean",
    "running_var": "moving_variance",
}


@dataclass(frozen=True)
class Sizes:
    """What may be smaller than published; the readers take the sizes from the files.

    Attributes
    ----------
    clusters, whitened : of NetVLAD and OpenIBL, whose whitenings are half a gigabyte each.
    hidden : units of AlexNet's classifier, which is most of its file and which nobody reads.
    """

    clusters: int = 64
    whitened: int = 4096
    hidden: int = 4096


OFFICIAL = Sizes()


def write_random_weights(folder: Path, seed: int = 0, sizes: Sizes = OFFICIAL) -> dict[str, Path]:
    """Write one file per network, and return them by the networks' names in the registry."""
    found = {}
    for name, write in _WRITERS.items():
        path = folder / _official_name(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(crc32(f"{seed}/{name}".encode()))
            write(path, sizes)
        found[name] = path
    return found


def _official_name(name: str) -> str:
    """The published file; of a TensorFlow checkpoint its index."""
    names = [file.name for file in registry()[name].files]
    return next((each for each in names if each.endswith(".index")), names[0])


def _superpoint(path: Path, _: Sizes) -> None:
    net = _spread(SuperPointNet())
    # descriptors around zero: else those of all keypoints are alike
    gray = nn.functional.interpolate(torch.rand(1, 1, 40, 40), scale_factor=4, mode="bilinear")
    features = torch.relu(net.convDa(net.encode(gray)))
    net.convDb.bias.sub_(net.convDb(features).mean((0, 2, 3)))
    torch.save(net.state_dict(), path)


def _superglue(path: Path, _: Sizes) -> None:
    net = SuperGlueNet()
    for key, value in net.named_parameters():
        # what is added to the descriptors: by their places, and by each layer of the graph
        if key.startswith("kenc.encoder.12.") or ".mlp.3." in key:
            value.mul_(0.01)
    size = net.descriptor_size
    turned = nn.init.orthogonal_(torch.empty(size, size))
    net.final_proj.weight.copy_((_SHARPNESS**0.5 * size**0.25) * turned[:, :, None])
    net.bin_score.fill_(_SHARPNESS * _DUSTBIN_COSINE)
    torch.save(net.state_dict(), path)


def _aslfeat(path: Path, _: Sizes) -> None:
    variables = {}
    for key, value in AslFeatNet().state_dict().items():
        *scopes, word = key.split(".")
        name = "/".join([*scopes, _TENSORFLOW_WORDS.get(word, word)])
        variables[name] = _tensorflow_layout(_aslfeat_values(key, value))
    write_tensorflow_checkpoint(path, variables)


def _aslfeat_values(key: str, value: torch.Tensor) -> torch.Tensor:
    drawn = torch.randn(value.shape)
    if key.startswith("deform_param."):
        return 0.02 * drawn
    if value.ndim == 4:
        return drawn * (2 / value[0].numel()) ** 0.5
    if key.endswith("running_mean"):
        return 0.1 * drawn
    return drawn.abs() / 2 + (2.0 if key.endswith("instance_max") else 0.5)


def _netvlad(path: Path, sizes: Sizes) -> None:
    net = _vgg_netvlad(sizes)
    layers: list[Any] = [{"type": "relu"}] * 34
    for number, layer in enumerate(net.base_model["base"].children()):
        if isinstance(layer, nn.Conv2d):
            layers[number] = _matconvnet("conv", layer.weight.permute(2, 3, 1, 0), layer.bias)
    centres = net.net_vlad.centroids
    layers[30] = _matconvnet("custom", net.net_vlad.conv.weight[:, :, 0, 0].T, -centres.T)
    layers[33] = _matconvnet("conv", net.pca_layer.weight.permute(2, 3, 1, 0), net.pca_layer.bias)
    image = np.tile(np.array(_MEAN_RGB, np.float32), (2, 2, 1))
    meta = {"normalization": {"averageImage": image}}
    savemat(path, {"net": {"layers": _cell(layers), "meta": meta}})


def _openibl(path: Path, sizes: Sizes) -> None:
    torch.save(_vgg_netvlad(sizes).state_dict(), path)


def _vgg_netvlad(sizes: Sizes) -> VggNetVlad:
    net = VggNetVlad(
        order="kd", mean_rgb=_MEAN_RGB, num_clusters=sizes.clusters, output_size=sizes.whitened
    )
    _spread(net.base_model)
    net.net_vlad.conv.weight.normal_(0, 20.0)
    net.net_vlad.centroids.normal_(0, 0.02)
    return net


def _matconvnet(kind: str, first: torch.Tensor, second: torch.Tensor | None) -> dict[str, Any]:
    """A layer of MatConvNet; a vector is one row."""
    values = [first.numpy(), np.atleast_2d(torch.zeros(0) if second is None else second.numpy())]
    return {"type": kind, "weights": _cell(values)}


def _cell(values: list[Any]) -> NDArray[Any]:
    found = np.empty((1, len(values)), object)
    for column, value in enumerate(values):
        found[0, column] = value
    return found


def _delg(path: Path, _: Sizes) -> None:
    net = DelgNet(101, "slim")
    variables = {
        _slim_name(key): _tensorflow_layout(_delg_values(key, value))
        for key, value in net.state_dict().items()
        if not key.endswith("num_batches_tracked")
    }
    write_saved_model(path, path.name.removesuffix(".tar.gz"), variables)


def _delg_values(key: str, value: torch.Tensor) -> torch.Tensor:
    if value.ndim > 1:
        return torch.randn(value.shape) * (2 / value[0].numel()) ** 0.5
    if key.endswith("running_var"):
        return 0.5 + 1.5 * torch.rand(value.shape)
    if key.endswith(".weight"):
        return 0.3 + 0.4 * torch.rand(value.shape)
    return 0.4 * torch.rand(value.shape) - 0.2


def _slim_name(key: str) -> str:
    """A key of torchvision's ResNet as TF-Slim's name of the variable."""
    *parts, word = key.split(".")
    if parts == ["embedding"]:
        return f"whitening/{'weights' if word == 'weight' else 'biases'}"
    scope = "resnet_v1_101"
    if parts[0].startswith("layer"):
        stage, block, *parts = parts
        scope += f"/block{stage.removeprefix('layer')}/unit_{int(block) + 1}/bottleneck_v1"
    norm = parts[0].startswith("bn") or parts[-1] == "1"
    layer = "shortcut" if parts[0] == "downsample" else parts[0].replace("bn", "conv")
    return f"{scope}/{layer}/" + (f"BatchNorm/{_SLIM_NORMS[word]}" if norm else "weights")


def _apgem(path: Path, _: Sizes) -> None:
    net = ApGemNet(101)
    net.fc.bias.zero_()  # which would be most of a vector of random weights
    attributes = {
        "mean_": (0.001 * torch.randn(2048)).numpy(),
        "components_": (torch.randn(2048, 2048) / 45).numpy(),
        "explained_variance_": (torch.rand(2048) + 0.01).numpy(),
        "whiten": True,
    }
    options = {"arch": "resnet101_rmac", "out_dim": 2048, "pooling": "gem", "gemp": 3}
    with _pca_class() as kind:
        pca = kind()
        pca.__dict__ |= attributes
        state = {f"module.{key}": value for key, value in net.state_dict().items()}
        parts = {"state_dict": state, "model_options": options, "pca": {"Landmarks_clean": pca}}
        torch.save(parts | {"preprocess": {"mean": [0.485, 0.456, 0.406], "input_size": 224}}, path)


@contextmanager
def _pca_class() -> Iterator[type]:
    """A class that is pickled under scikit-learn's name, which is not installed here."""
    kind = type("PCA", (), {"__module__": _PCA_MODULE})
    parts = _PCA_MODULE.split(".")
    names = [".".join(parts[:count]) for count in range(1, len(parts) + 1)]
    before = {name: sys.modules.get(name) for name in names}
    sys.modules |= {name: ModuleType(name) for name in names}
    sys.modules[_PCA_MODULE].__dict__["PCA"] = kind
    try:
        yield kind
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def _lpips_trunk(path: Path, sizes: Sizes) -> None:
    state = _lpips_state(lambda key: key.startswith("features."))
    inputs = 256 * 6 * 6
    for layer, outputs in ((1, sizes.hidden), (4, sizes.hidden), (6, 1000)):
        state[f"classifier.{layer}.weight"] = torch.randn(outputs, inputs)
        state[f"classifier.{layer}.bias"] = torch.zeros(outputs)
        inputs = outputs
    torch.save(state, path)


def _lpips_heads(path: Path, _: Sizes) -> None:
    state = _lpips_state(lambda key: key.startswith("lin"))
    torch.save({key: value.abs() for key, value in state.items()}, path)


def _lpips_state(wanted: Callable[[str], bool]) -> dict[str, torch.Tensor]:
    state = _spread(Lpips("alex")).state_dict()
    return {key: value for key, value in state.items() if wanted(key)}


def _deeplab(path: Path, _: Sizes) -> None:
    net = _spread(DeepLabV3Plus("resnet101", num_classes=19))
    # random labels stand still, so that masks leave something of the images
    logits = net.eval()(torch.rand(1, 3, 129, 161))
    net.get_parameter("classifier.classifier.3.bias")[:_STANDING_CLASSES].add_(2.0 * logits.std())
    state = {"model_state": net.state_dict(), "cur_itrs": 30_000, "best_score": np.float64(0.7)}
    torch.save(state, path)


_WRITERS: dict[str, Callable[[Path, Sizes], None]] = {
    "superpoint_v1": _superpoint,
    "superglue_outdoor": _superglue,
    "superglue_indoor": _superglue,
    "aslfeat": _aslfeat,
    "netvlad-pitts30k": _netvlad,
    "openibl": _openibl,
    "delg-r101-gldv2clean": _delg,
    "apgem-resnet101-lm18": _apgem,
    "lpips-trunk-alex": _lpips_trunk,
    "lpips-alex": _lpips_heads,
    "deeplabv3plus-resnet101": _deeplab,
}


def _spread(net: nn.Module) -> Any:
    """He's way to begin: what a layer gives has the size of what it is given."""
    for value in net.parameters():
        if value.ndim > 2:
            nn.init.kaiming_normal_(value)
    return net


def _tensorflow_layout(value: torch.Tensor) -> NDArray[np.float32]:
    """Kernels (H, W, in, out) where torch has (out, in, H, W); dense layers as 1x1 kernels."""
    if value.ndim == 2:
        value = value[:, :, None, None]
    if value.ndim == 4:
        value = value.permute(2, 3, 1, 0)
    return np.ascontiguousarray(value.numpy(), np.float32).reshape(value.shape)


def main() -> None:
    """Write all of them where ``megloc`` finds what is not the published file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of weights, for MEGLOC_WEIGHTS; 2.5 GB")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--small", action="store_true", help="smaller whitenings and classifiers")
    options = parser.parse_args()
    sizes = Sizes(clusters=4, whitened=32, hidden=8) if options.small else OFFICIAL
    for name, path in write_random_weights(
        options.folder / UNVERIFIED, options.seed, sizes
    ).items():
        print(f"{name:24s}  {path}")


if __name__ == "__main__":
    main()
