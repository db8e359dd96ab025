"""Random weights for the preset ``megloc``, in the published or converted file formats.

    .venv/bin/python benchmarks/whole_preset_weights.py DIR
    MEGLOC_WEIGHTS=DIR make eval DATASET=synthetic-aachen PRESET=megloc

Each file has the official or converted name, keys and shapes; the values are drawn from a seed.
Where torch's default initialization gives degenerate outputs (a flat score map, a graph network
whose updates dominate the descriptors), the values are rescaled so that features respond to texture
and matches to descriptors, and the later stages get useful inputs.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn

from megloc_kapture.features.aliked import AlikedNet
from megloc_kapture.features.aslfeat import AslFeatNet
from megloc_kapture.features.r2d2 import R2D2Network
from megloc_kapture.features.superpoint import SuperPointNet
from megloc_kapture.io.weights import UNVERIFIED, registry
from megloc_kapture.nets.delg import DelgNet
from megloc_kapture.nets.global_descriptors import ApGemNet, VggNetVlad
from megloc_kapture.nets.lpips import Lpips
from megloc_kapture.nets.megaloc import MegaLocNet
from megloc_kapture.nets.superglue import SuperGlueNet
from megloc_kapture.preprocessing.deeplab import DeepLabV3Plus

_MEAN_RGB = (123.68, 116.779, 103.939)
_STATIC_CLASSES = 11  # of Cityscapes; they precede person, rider and the vehicles
# sharpness of the matching scores, and cosine similarity equivalent to the dustbin score
_SHARPNESS, _DUSTBIN_COSINE = 30.0, 0.6


@dataclass(frozen=True)
class Sizes:
    """Layer sizes that may differ from the published ones; readers take them from the files.

    Attributes
    ----------
    clusters, whitened : sizes of NetVLAD and OpenIBL, whose whitenings take half a gigabyte each.
    hidden : units of AlexNet's classifier, the largest part of its file, which is not used.
    """

    clusters: int = 64
    whitened: int = 4096
    hidden: int = 4096


OFFICIAL = Sizes()


def write_random_weights(
    folder: Path, seed: int = 0, sizes: Sizes = OFFICIAL, names: Collection[str] = ()
) -> dict[str, Path]:
    """Write one file per network; return the paths by registry name.

    ``names`` selects networks of the preset ``megloc`` (default: all) or of ``FREE_NETWORKS``.
    """
    paths = {}
    for name in names or _WRITERS:
        write = _WRITERS.get(name) or _FREE_WRITERS[name]
        path = folder / _official_name(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(crc32(f"{seed}/{name}".encode()))
            write(path, sizes)
        paths[name] = path
    return paths


def _official_name(name: str) -> str:
    """Return the name of the published file, or of the converted file if that one is read."""
    names = [file.name for file in registry()[name].files if not file.convert]
    return names[0] if names else registry()[name].converted


def _superpoint(path: Path, _: Sizes) -> None:
    net = _kaiming(SuperPointNet())
    # centre the descriptors; otherwise those of all keypoints are similar
    gray = nn.functional.interpolate(torch.rand(1, 1, 40, 40), scale_factor=4, mode="bilinear")
    features = torch.relu(net.convDa(net.encode(gray)))
    net.convDb.bias.sub_(net.convDb(features).mean((0, 2, 3)))
    torch.save(net.state_dict(), path)


def _superglue(path: Path, _: Sizes) -> None:
    net = SuperGlueNet()
    for key, value in net.named_parameters():
        # updates of the descriptors, by the positional encoding and by each layer
        if key.startswith("kenc.encoder.12.") or ".mlp.3." in key:
            value.mul_(0.01)
    size = net.descriptor_size
    rotation = nn.init.orthogonal_(torch.empty(size, size))
    net.final_proj.weight.copy_((_SHARPNESS**0.5 * size**0.25) * rotation[:, :, None])
    net.bin_score.fill_(_SHARPNESS * _DUSTBIN_COSINE)
    torch.save(net.state_dict(), path)


def _aslfeat(path: Path, _: Sizes) -> None:
    state = AslFeatNet().state_dict()
    save_file({key: _aslfeat_values(key, value) for key, value in state.items()}, path)


def _aslfeat_values(key: str, value: torch.Tensor) -> torch.Tensor:
    normal = torch.randn(value.shape)
    if key.startswith("deform_param."):
        return 0.02 * normal
    if value.ndim == 4:
        return normal * (2 / value[0].numel()) ** 0.5
    if key.endswith("running_mean"):
        return 0.1 * normal
    return normal.abs() / 2 + (2.0 if key.endswith("instance_max") else 0.5)


def _netvlad(path: Path, sizes: Sizes) -> None:
    state = {**_vgg_netvlad(sizes).state_dict(), "average_image": torch.tensor(_MEAN_RGB)}
    save_file(state, path)


def _openibl(path: Path, sizes: Sizes) -> None:
    torch.save(_vgg_netvlad(sizes).state_dict(), path)


def _vgg_netvlad(sizes: Sizes) -> VggNetVlad:
    net = VggNetVlad(
        order="kd", mean_rgb=_MEAN_RGB, num_clusters=sizes.clusters, output_size=sizes.whitened
    )
    _kaiming(net.base_model)
    net.net_vlad.conv.weight.normal_(0, 20.0)
    net.net_vlad.centroids.normal_(0, 0.02)
    return net


def _delg(path: Path, _: Sizes) -> None:
    state = DelgNet(101, "slim").state_dict()
    counters = {key for key in state if key.endswith("num_batches_tracked")}
    values = {k: _delg_values(k, value) for k, value in state.items() if k not in counters}
    save_file(values, path)


def _delg_values(key: str, value: torch.Tensor) -> torch.Tensor:
    if value.ndim > 1:
        return torch.randn(value.shape) * (2 / value[0].numel()) ** 0.5
    if key.endswith("running_var"):
        return 0.5 + 1.5 * torch.rand(value.shape)
    if key.endswith(".weight"):
        return 0.3 + 0.4 * torch.rand(value.shape)
    return 0.4 * torch.rand(value.shape) - 0.2


def _apgem(path: Path, _: Sizes) -> None:
    net = ApGemNet(101)
    net.fc.bias.zero_()  # a random bias would dominate the descriptor
    whitening = {
        "mean": 0.001 * torch.randn(2048),
        "components": torch.randn(2048, 2048) / 45,
        "explained_variance": torch.rand(2048) + 0.01,
        "whiten": torch.tensor(True),
    }
    parts = {f"pca.Landmarks_clean.{part}": value for part, value in whitening.items()}
    save_file({**net.state_dict(), **parts}, path)


def _lpips_trunk(path: Path, sizes: Sizes) -> None:
    state = _lpips_state("features.")
    inputs = 256 * 6 * 6
    for layer, outputs in ((1, sizes.hidden), (4, sizes.hidden), (6, 1000)):
        state[f"classifier.{layer}.weight"] = torch.randn(outputs, inputs)
        state[f"classifier.{layer}.bias"] = torch.zeros(outputs)
        inputs = outputs
    torch.save(state, path)


def _lpips_heads(path: Path, _: Sizes) -> None:
    state = _lpips_state("lin")
    torch.save({key: value.abs() for key, value in state.items()}, path)


def _lpips_state(prefix: str) -> dict[str, torch.Tensor]:
    state = _kaiming(Lpips("alex")).state_dict()
    return {key: value for key, value in state.items() if key.startswith(prefix)}


def _deeplab(path: Path, _: Sizes) -> None:
    net = _kaiming(DeepLabV3Plus("resnet101", num_classes=19))
    # favour static classes, so that the masks keep part of each image
    logits = net.eval()(torch.rand(1, 3, 129, 161))
    net.get_parameter("classifier.classifier.3.bias")[:_STATIC_CLASSES].add_(2.0 * logits.std())
    state = {"model_state": net.state_dict(), "cur_itrs": 30_000, "best_score": np.float64(0.7)}
    torch.save(state, path)


def _aliked(path: Path, _: Sizes) -> None:
    torch.save(_kaiming(AlikedNet((16, 32, 64, 128), positions=16)).state_dict(), path)


def _r2d2(path: Path, _: Sizes) -> None:
    net = _kaiming(R2D2Network())
    net.sal.bias.fill_(
        1.0
    )  # otherwise few pixels pass the repeatability and reliability thresholds
    net.clf.bias.copy_(torch.tensor([-1.0, 1.0]))
    state = {f"module.{key}": value for key, value in net.state_dict().items()}
    torch.save({"net": "Quad_L2Net_ConfCFS()", "state_dict": state}, path)


def _xfeat(path: Path, _: Sizes) -> None:
    torch.save(_kaiming(_kornia("XFeat").net).state_dict(), path)


def _disk(path: Path, _: Sizes) -> None:
    torch.save({"extractor": _kornia("DISK").state_dict()}, path)


def _lightglue(path: Path, _: Sizes) -> None:
    net = _kornia("LightGlue", None, flash=False)
    for layer in net.transformers:  # keep updates small relative to the descriptors
        for block in (layer.self_attn, layer.cross_attn):
            block.ffn[-1].weight.mul_(0.1)
    for head in net.log_assignment:
        rotation = nn.init.orthogonal_(torch.empty(256, 256))
        head.final_proj.weight.copy_((_SHARPNESS**0.5 * 4) * rotation)
        head.final_proj.bias.zero_()
        head.matchability.bias.fill_(3.0)
    state = {
        key: value for key, value in net.state_dict().items() if key != "confidence_thresholds"
    }
    torch.save(state, path)


def _kornia(name: str, *arguments: Any, **named: Any) -> Any:
    return getattr(importlib.import_module("kornia.feature"), name)(*arguments, **named)


def _megaloc(path: Path, _: Sizes) -> None:
    with torch.device("meta"):
        shapes = MegaLocNet().state_dict()
    save_file({key: 0.02 * torch.randn(value.shape) for key, value in shapes.items()}, path)


_FREE_WRITERS: dict[str, Callable[[Path, Sizes], None]] = {
    "aliked-n16": _aliked,
    "r2d2_WASF_N16": _r2d2,
    "xfeat": _xfeat,
    "disk": _disk,
    "superpoint_lightglue": _lightglue,
    "megaloc": _megaloc,
}
FREE_NETWORKS = tuple(_FREE_WRITERS)

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


def _kaiming(net: nn.Module) -> Any:
    """Initialize the weights by He et al., so that activations keep their magnitude."""
    for value in net.parameters():
        if value.ndim > 2:
            nn.init.kaiming_normal_(value)
    return net


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="weights folder for MEGLOC_WEIGHTS; 2.5 GB")
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
