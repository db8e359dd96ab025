"""Random weights for the preset ``megloc``, in files as they are published or converted.

    .venv/bin/python benchmarks/whole_preset_weights.py DIR
    MEGLOC_WEIGHTS=DIR make eval DATASET=synthetic-aachen PRESET=megloc

Every file has the official or the converted name, and its keys and shapes; the numbers are drawn
from a seed.
Where torch's own way to begin a network would let nothing through (a score map that is flat, a
graph that drowns the descriptors), the numbers are scaled so that features still answer to texture
and matches to descriptors: then every stage after them has something to do.
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
_STANDING_CLASSES = 11  # of Cityscapes, before person, rider and the vehicles
# how sharply SuperGlue tells similar descriptors apart, and the cosine that the dustbin has
_SHARPNESS, _DUSTBIN_COSINE = 30.0, 0.6


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


def write_random_weights(
    folder: Path,
    seed: int = 0,
    sizes: Sizes = OFFICIAL,
    names: Collection[str] = (),
) -> dict[str, Path]:
    """Write one file per network, and return them by the networks' names in the registry.

    ``names`` replaces the networks of the preset ``megloc``; it may have those of the free networks
    (``FREE_NETWORKS``).
    """
    found = {}
    for name in names or _WRITERS:
        write = _WRITERS.get(name) or _FREE_WRITERS[name]
        path = folder / _official_name(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(crc32(f"{seed}/{name}".encode()))
            write(path, sizes)
        found[name] = path
    return found


def _official_name(name: str) -> str:
    """The published file that is read as it is, or the converted one."""
    names = [file.name for file in registry()[name].files if not file.convert]
    return names[0] if names else registry()[name].converted


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
    state = AslFeatNet().state_dict()
    save_file({key: _aslfeat_values(key, value) for key, value in state.items()}, path)


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
    state = {**_vgg_netvlad(sizes).state_dict(), "average_image": torch.tensor(_MEAN_RGB)}
    save_file(state, path)


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
    net.fc.bias.zero_()  # which would be most of a vector of random weights
    whitening = {
        "mean": 0.001 * torch.randn(2048),
        "components": torch.randn(2048, 2048) / 45,
        "explained_variance": torch.rand(2048) + 0.01,
        "whiten": torch.tensor(True),
    }
    parts = {f"pca.Landmarks_clean.{part}": value for part, value in whitening.items()}
    save_file({**net.state_dict(), **parts}, path)


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


def _aliked(path: Path, _: Sizes) -> None:
    torch.save(_spread(AlikedNet((16, 32, 64, 128), positions=16)).state_dict(), path)


def _r2d2(path: Path, _: Sizes) -> None:
    net = _spread(R2D2Network())
    net.sal.bias.fill_(1.0)  # else few pixels are repeatable and reliable enough
    net.clf.bias.copy_(torch.tensor([-1.0, 1.0]))
    state = {f"module.{key}": value for key, value in net.state_dict().items()}
    torch.save({"net": "Quad_L2Net_ConfCFS()", "state_dict": state}, path)


def _xfeat(path: Path, _: Sizes) -> None:
    torch.save(_spread(_kornia("XFeat").net).state_dict(), path)


def _disk(path: Path, _: Sizes) -> None:
    torch.save({"extractor": _kornia("DISK").state_dict()}, path)


def _lightglue(path: Path, _: Sizes) -> None:
    net = _kornia("LightGlue", None, flash=False)
    for layer in net.transformers:  # so that descriptors are not drowned
        for block in (layer.self_attn, layer.cross_attn):
            block.ffn[-1].weight.mul_(0.1)
    for head in net.log_assignment:
        turned = nn.init.orthogonal_(torch.empty(256, 256))
        head.final_proj.weight.copy_((_SHARPNESS**0.5 * 4) * turned)
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


def _spread(net: nn.Module) -> Any:
    """He's way to begin: what a layer gives has the size of what it is given."""
    for value in net.parameters():
        if value.ndim > 2:
            nn.init.kaiming_normal_(value)
    return net


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
