"""Networks of kornia with local weight files: XFeat, DISK, LightGlue and LighterGlue.

kornia's ``from_pretrained`` downloads weights. Instead, each module is built without weights and
loaded strictly from a local file.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Callable, Mapping
from functools import partial
from threading import Lock
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.nets.runtime import batch_counters, load_strictly

Tensors = Mapping[str, torch.Tensor]
_BLOCK = re.compile(r"^(self_attn|cross_attn)\.(\d+)\.")
# keys of DISK's LightGlue that the published code does not read
_UNUSED = re.compile(r"^log_assignment\.\d+\.r$")
# the authors' file of LighterGlue also contains XFeat's weights
_MATCHER, _EXTRACTOR = "matcher.", "extractor.model.net."
_building = Lock()


def require_kornia(what: str) -> None:
    if importlib.util.find_spec("kornia") is None:
        raise OptionError(f"{what} needs kornia: pip install 'megloc-kapture[torch]'")


def load_xfeat(tensors: Tensors, where: str) -> nn.Module:
    """Build XFeat (Potje et al., CVPR 2024) from the authors' ``xfeat.pt``."""
    network = _features().XFeat()
    keys = network.net.state_dict()
    unused = {key for key in keys if key.startswith("fine_matcher.")} | batch_counters(network.net)
    load_strictly(network.net, tensors, where, may_lack=unused)
    return network.eval()


def xfeat_descriptors(network: Any, image: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """Return unit-norm descriptors (N, 64) of an image (1, 3, H, W).

    ``xy`` (N, 2) are keypoints of kornia's XFeat, in its pixel coordinates.
    """
    resized, *ratio_yx = network._preprocess_tensor(image)
    dense = functional.normalize(network.net(resized)[0], dim=1)
    resized_xy = xy / xy.new_tensor(ratio_yx[::-1])
    height, width = resized.shape[-2:]
    sampled = network.interpolator(dense, resized_xy[None], H=height, W=width)[0]
    return functional.normalize(sampled, dim=-1)


def load_disk(tensors: Tensors, where: str) -> nn.Module:
    """Build DISK (Tyszkiewicz et al., NeurIPS 2020) from the authors' ``depth-save.pth``."""
    return load_strictly(_features().DISK(), tensors, where).eval()


def load_lighterglue(tensors: Tensors, where: str, *options: Any) -> nn.Module:
    """Build LighterGlue, XFeat's LightGlue, from the authors' ``xfeat-lighterglue.pt``."""
    named = {
        key.removeprefix(_MATCHER): value
        for key, value in tensors.items()
        if not key.startswith(_EXTRACTOR)
    }
    return load_lightglue(named, where, *options, width=96, num_heads=1)


def load_lightglue(
    tensors: Tensors,
    where: str,
    threshold: float = 0.1,
    depth_confidence: float = 0.95,
    width_confidence: float = 0.99,
    half_precision: bool = False,
    *,
    width: int = 256,
    num_heads: int = 4,
) -> nn.Module:
    """Build LightGlue (Lindenberger et al., ICCV 2023) from one of the authors' files.

    By default the network stops early (``depth_confidence``) and drops keypoints
    (``width_confidence``), as the authors' does. A value of -1 disables either; tensors that
    are then unneeded may be missing. Positional encoding and assignment are never in half
    precision.
    """
    tensors = {
        _BLOCK.sub(r"transformers.\2.\1.", key): value
        for key, value in tensors.items()
        if not _UNUSED.search(key)
    }
    layers = {int(key.split(".")[1]) for key in tensors if key.startswith("transformers.")}
    if not layers:
        raise DataError("this file does not fit LightGlue: it has no layers", path=where)
    projection = tensors.get("input_proj.weight")
    with _building:
        # kornia's attention changes this setting for the whole process
        flash = torch.backends.cuda.flash_sdp_enabled()  # type: ignore[no-untyped-call]
        try:
            network = _features().LightGlue(
                None,
                flash=False,
                n_layers=max(layers) + 1,
                input_dim=width if projection is None else projection.shape[-1],
                descriptor_dim=width,
                num_heads=num_heads,
                filter_threshold=threshold,
                depth_confidence=depth_confidence,
                width_confidence=width_confidence,
            )
        finally:
            torch.backends.cuda.enable_flash_sdp(flash)
    optional = ["confidence_thresholds"]
    if depth_confidence <= 0:
        optional.append("token_confidence.")
        if width_confidence <= 0:
            optional += [f"log_assignment.{layer}." for layer in range(max(layers))]
    unused = [key for key in network.state_dict() if key.startswith(tuple(optional))]
    load_strictly(network, tensors, where, may_lack=unused)
    for layer in network.transformers:
        layer.cross_attn.forward = partial(_cross_attention, layer.cross_attn)
        if half_precision:
            layer.forward = _in_half_precision(layer.forward)
    return network.eval()


def _cross_attention(
    block: Any, x0: torch.Tensor, x1: torch.Tensor, mask: None = None
) -> tuple[torch.Tensor, ...]:
    """Compute kornia's cross-attention without (heads, N, M) matrices, in 20 % less time."""
    (query0, value0), (query1, value1) = (
        [
            project(x).unflatten(-1, (block.heads, -1)).transpose(1, 2)
            for project in (block.to_qk, block.to_v)
        ]
        for x in (x0, x1)
    )
    updated = []
    for x, query, key, value in ((x0, query0, query1, value1), (x1, query1, query0, value0)):
        message = functional.scaled_dot_product_attention(query, key, value)
        message = block.to_out(message.transpose(1, 2).flatten(start_dim=-2))
        updated.append(x + block.ffn(torch.cat([x, message], dim=-1)))
    return tuple(updated)


def _in_half_precision(forward: Callable[..., Any]) -> Callable[..., Any]:
    def run(x: torch.Tensor, *others: Any, **named: Any) -> Any:
        half = torch.float16 if x.device.type == "cuda" else torch.bfloat16
        with torch.autocast(x.device.type, dtype=half):
            return tuple(output.float() for output in forward(x, *others, **named))

    return run


def _features() -> Any:
    return importlib.import_module("kornia.feature")
