"""LightGlue (Lindenberger et al., ICCV 2023) for the features it has weights for."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from pydantic import Field

from megloc_kapture.matching.learned_pairs import LearnedPairs, LearnedPairsOptions
from megloc_kapture.nets.lightglue import (
    LightGlueNetwork,
    LightGlueShape,
    load_lightglue,
    renamed_blocks,
)

_SHAPE = LightGlueShape(width=256, num_heads=4)


class LightGlueOptions(LearnedPairsOptions):
    """Options of LightGlue."""

    weights: str = Field(
        default="superpoint_lightglue",
        description="superpoint_lightglue, aliked_lightglue, or a file: those of the features",
    )


class LightGlue(LearnedPairs):
    """The matcher ``lightglue``, for SuperPoint's features or ALIKED's; needs kornia."""

    Options = LightGlueOptions

    def __init__(self, options: LightGlueOptions | None = None) -> None:
        super().__init__(options or LightGlueOptions(), _load)


def _load(tensors: Mapping[str, torch.Tensor], where: str) -> LightGlueNetwork:
    return load_lightglue(renamed_blocks(tensors), where, _SHAPE)
