"""LighterGlue, the LightGlue that was trained for XFeat: its checkpoints by kornia's names."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from megloc_kapture.errors import DataError
from megloc_kapture.nets.lightglue import (
    LightGlueNetwork,
    LightGlueShape,
    load_lightglue,
    renamed_blocks,
)

_SHAPE = LightGlueShape(width=96, num_heads=1)

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


def load_lighterglue(tensors: Mapping[str, torch.Tensor], where: str) -> LightGlueNetwork:
    """The network with the tensors of a checkpoint, for inference.

    Takes the authors' ``xfeat-lighterglue.pt`` (6 layers, and beside them the XFeat they were
    trained with, which is left out) and ``lighterglue_L3.onnx`` (the first 3 with their assignment,
    the same values).

    Raises
    ------
    DataError : the tensors do not fit; names their keys.
    OptionError : kornia is not installed.
    """
    if f"{_ONNX_PREFIX}input_proj.bias" in tensors:
        named = _of_onnx(tensors, where)
    else:
        matcher = {
            key.removeprefix(_MATCHER): value
            for key, value in tensors.items()
            if not key.startswith(_EXTRACTOR)
        }
        named = renamed_blocks(matcher)
    return load_lightglue(named, where, _SHAPE)


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
