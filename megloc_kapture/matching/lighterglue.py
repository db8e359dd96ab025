"""LighterGlue: LightGlue for XFeat's keypoints, small and fast."""

from __future__ import annotations

from pydantic import Field

from megloc_kapture.matching.learned_pairs import LearnedPairs, LearnedPairsOptions
from megloc_kapture.nets.lighterglue import load_lighterglue


class LighterGlueOptions(LearnedPairsOptions):
    """Options of LighterGlue."""

    weights: str = Field(default="xfeat-lighterglue", description="name in the registry, or a file")


class LighterGlue(LearnedPairs):
    """The matcher ``lighterglue`` for features of type ``xfeat``; needs kornia."""

    Options = LighterGlueOptions

    def __init__(self, options: LighterGlueOptions | None = None) -> None:
        super().__init__(options or LighterGlueOptions(), load_lighterglue)
