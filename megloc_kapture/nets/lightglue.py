"""LightGlue (Lindenberger et al., ICCV 2023): kornia's layers with official checkpoints.

kornia's modules are taken as they are; what joins them is written here, because a batch of pairs
with different numbers of keypoints has to be padded, and because a pair's matches must not depend
on the pairs it is batched with: there is neither early stopping nor pruning of points.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from threading import Lock
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.nets.runtime import load_strictly

_BLOCK = re.compile(r"^(self_attn|cross_attn)\.(\d+)\.")
_building = Lock()
# the authors' file is of their module for training: the matcher, and the XFeat it was trained with
_MATCHER = "matcher."
_EXTRACTOR = "extractor.model.net."
# The ONNX export of the first three layers names biases, but numbers the matrices of products, and
# stores them transposed; a layer's numbers follow the layer before's at a fixed distance.
_ONNX_PREFIX = "net."
_ONNX_LAYERS = 3
_ONNX_DISTANCE = 18
_ONNX_LAYER = {
    986: "self_attn.Wqkv",
    987: "self_attn.out_proj",
    988: "self_attn.ffn.0",
    989: "self_attn.ffn.3",
    994: "cross_attn.to_qk",
    996: "cross_attn.to_v",
    998: "cross_attn.to_out",
    1000: "cross_attn.ffn.0",
    1001: "cross_attn.ffn.3",
}
_ONNX_OTHERS = {
    982: "input_proj",
    984: "posenc.Wr",
    1040: "log_assignment.2.final_proj",
    1042: "log_assignment.2.matchability",
}


@dataclass(frozen=True, eq=False)
class KeypointBatch:
    """Keypoints of one side of several pairs."""

    # points, descriptors: (B, N, 2), normalised to [-1, 1], and (B, N, D), of the weights' type
    points: torch.Tensor
    descriptors: torch.Tensor
    # bool (B, N, 1), False where a row is padding; None: all are there
    present: torch.Tensor | None = None


def require_kornia() -> None:
    """Raise OptionError where kornia is not installed."""
    if importlib.util.find_spec("kornia") is None:
        raise OptionError(
            "LightGlue and LighterGlue need kornia: pip install 'megloc-kapture[kornia]'"
        )


class LightGlueNetwork(nn.Module):
    """LightGlue of kornia's layers, at full depth and width.

    ``parts`` is an instance of kornia's LightGlue, ``descriptor_size`` of what it takes.
    """

    parts: Any

    def __init__(self, parts: nn.Module, descriptor_size: int) -> None:
        super().__init__()
        self.parts = parts
        self.descriptor_size = descriptor_size

    def forward(self, a: KeypointBatch, b: KeypointBatch) -> torch.Tensor:
        """Logarithm of the probability that two keypoints match (B, M, N), of the points' type.

        Sections 3.1 to 3.3 of the paper; minus infinity where there is padding. Under autocast the
        layers run in half precision, positions and the assignment do not.
        """
        masks = _masks(a, b)
        x, y = self.parts.input_proj(a.descriptors), self.parts.input_proj(b.descriptors)
        with torch.autocast(x.device.type, enabled=False):
            where_x, where_y = self.parts.posenc(a.points), self.parts.posenc(b.points)
        of_heads = [mask[:, None] for mask in masks]
        for layer in self.parts.transformers:
            x, y = layer(x, y, where_x, where_y, *of_heads)
        with torch.autocast(x.device.type, enabled=False):
            x, y = x.to(a.points.dtype), y.to(a.points.dtype)
            return _assignment(self.parts.log_assignment[-1], x, y, masks)


def load_lightglue(
    tensors: Mapping[str, torch.Tensor], where: str, *, width: int = 256, num_heads: int = 4
) -> LightGlueNetwork:
    """kornia's LightGlue with the tensors of a checkpoint, for inference.

    The number of layers and the size of descriptors are the checkpoint's. What only early stopping
    and pruning would use may be absent. Raises DataError that names the keys that do not fit, and
    OptionError where kornia is not installed. ``tensors``: by the official names, or by kornia's:
    ``self_attn.3.x``, or ``transformers.3.self_attn.x``.
    """
    require_kornia()
    tensors = {_BLOCK.sub(r"transformers.\2.\1.", key): value for key, value in tensors.items()}
    layers = {int(key.split(".")[1]) for key in tensors if key.startswith("transformers.")}
    if not layers:
        raise DataError("this file does not fit LightGlue: it has no layers", path=where)
    projection = tensors.get("input_proj.weight")
    descriptor_size = width if projection is None else projection.shape[-1]
    sizes = {"input_dim": descriptor_size, "descriptor_dim": width, "num_heads": num_heads}
    parts = _untrained(n_layers=max(layers) + 1, **sizes)
    last = f"log_assignment.{max(layers)}."
    unused = [
        key
        for key in parts.state_dict()
        if key.startswith(("token_confidence.", "confidence_thresholds", "log_assignment."))
        and not key.startswith(last)
    ]
    load_strictly(parts, tensors, where, may_lack=unused)
    return LightGlueNetwork(parts, descriptor_size).eval()


def _untrained(**conf: int) -> nn.Module:
    kornia: Any = importlib.import_module("kornia.feature")
    cuda: Any = torch.backends.cuda
    with _building:
        flash = cuda.flash_sdp_enabled()
        try:
            parts: nn.Module = kornia.LightGlue(None, flash=False, **conf)
        finally:
            cuda.enable_flash_sdp(flash)  # kornia's attention sets it for the whole process
    return parts


def _assignment(
    head: Any, x: torch.Tensor, y: torch.Tensor, masks: tuple[torch.Tensor, ...]
) -> torch.Tensor:
    """Equations 6 to 8 of the paper, for descriptors (B, M, D) and (B, N, D)."""
    # the square root of the width: the authors divide each side by its fourth root
    product = head.final_proj(x) @ head.final_proj(y).mT / x.shape[-1] ** 0.5
    matchable = functional.logsigmoid(head.matchability(x)) + (
        functional.logsigmoid(head.matchability(y)).mT
    )
    absent = ~(masks[0] & masks[1].mT) if masks else None
    if absent is not None:
        product = product.masked_fill(absent, -torch.inf)
    both = functional.log_softmax(product, 2) + functional.log_softmax(product, 1) + matchable
    # rows that are padding as a whole have become not a number
    return both if absent is None else both.masked_fill(absent, -torch.inf)


def mutual_matches(
    log_probability: torch.Tensor, threshold: float
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """For each pair of a batch (B, M, N) the matches int64 (K, 2), by row, and scores (K,).

    A match is the largest of its row and of its column, and its probability above the threshold.
    """
    best_of_row, column = log_probability.max(dim=2)
    row_of_column = log_probability.argmax(dim=1)
    rows = torch.arange(log_probability.shape[1], device=log_probability.device)
    probability = best_of_row.exp()
    found = (row_of_column.gather(1, column) == rows) & (probability > threshold)
    for pair in range(len(log_probability)):
        chosen = torch.nonzero(found[pair])[:, 0]
        yield torch.stack([chosen, column[pair, chosen]], dim=1), probability[pair, chosen]


def _masks(a: KeypointBatch, b: KeypointBatch) -> tuple[torch.Tensor, ...]:
    """None where nothing is padded: attention is faster without."""
    if a.present is None and b.present is None:
        return ()
    sides = (a, b)
    return tuple(
        torch.ones_like(side.points[..., :1], dtype=torch.bool)
        if side.present is None
        else side.present
        for side in sides
    )


def load_lighterglue(tensors: Mapping[str, torch.Tensor], where: str) -> LightGlueNetwork:
    """The network with the tensors of a checkpoint, for inference.

    Takes the authors' ``xfeat-lighterglue.pt`` (6 layers, and beside them the XFeat they were
    trained with, which is left out) and ``lighterglue_L3.onnx`` (the first 3 with their assignment,
    the same values). Raises as :func:`load_lightglue`.
    """
    if f"{_ONNX_PREFIX}input_proj.bias" in tensors:
        named = _of_onnx(tensors, where)
    else:
        named = {
            key.removeprefix(_MATCHER): value
            for key, value in tensors.items()
            if not key.startswith(_EXTRACTOR)
        }
    return load_lightglue(named, where, width=96, num_heads=1)


def _of_onnx(tensors: Mapping[str, torch.Tensor], where: str) -> dict[str, torch.Tensor]:
    named = {
        key.removeprefix(_ONNX_PREFIX): value
        for key, value in tensors.items()
        if key.startswith(_ONNX_PREFIX)
    }
    numbers = dict(_ONNX_OTHERS)
    for layer in range(_ONNX_LAYERS):
        for number, target in _ONNX_LAYER.items():
            numbers[number + layer * _ONNX_DISTANCE] = f"transformers.{layer}.{target}"
    for number, target in numbers.items():
        matrix = tensors.get(f"onnx::MatMul_{number}")
        if matrix is None:
            raise DataError(
                f"this file does not fit LighterGlue; 1 missing keys: onnx::MatMul_{number}",
                path=where,
            )
        named[f"{target}.weight"] = matrix.T
    return named
