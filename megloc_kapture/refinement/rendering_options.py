"""Options of the refinement by rendering."""

from __future__ import annotations

from pydantic import Field

from megloc_kapture.refinement.photometric import MIN_POINTS
from megloc_kapture.refinement.photometric_pyramid import Appearance
from megloc_kapture.values import Options


class RenderingOptions(Options):
    """Options of the refinement by rendering."""

    appearance: Appearance = Field(
        default="normalised",
        description="what is compared: brightness of locally normalised contrast (day and night), "
        "plain brightness (intensity), or magnitudes of its gradient (gradients)",
    )
    max_references: int = Field(
        default=4,
        gt=0,
        description="reference images with depth that are used, best first",
    )
    max_points: int = Field(
        default=12000,
        ge=MIN_POINTS,
        description="points of a reference and level of its pyramid",
    )
    max_side_px: int = Field(
        default=640,
        ge=64,
        description="longer side of the finest level; larger images are reduced",
    )
    levels: int = Field(
        default=3,
        ge=1,
        description="of the pyramids, each of half the size; begin at the coarsest",
    )
    search_deg: float = Field(
        default=4.0,
        ge=0,
        description="turns of the camera that are tried at the coarsest level",
    )
    max_translation_m: float = Field(
        default=0.5,
        gt=0,
        description="a pose whose centre moves further is not accepted",
    )
    max_rotation_deg: float = Field(
        default=5.0, gt=0, description="a pose that turns further is not accepted"
    )
    require_consistent_map: bool = Field(
        default=True,
        description="refine only where the map's own images, held out, would stay where they are",
    )
    min_significance: float = Field(
        default=2.5,
        ge=0,
        description="by how many of its standard errors the robust cost must fall, parts of the "
        "query being the observations",
    )
    min_correlation: float = Field(
        default=0.12,
        ge=-1,
        le=1,
        description="of the query with the warped references, below which a pose is not accepted",
    )
    min_overlap: float = Field(
        default=0.2,
        ge=0,
        le=1,
        description="share of the query that references must cover",
    )
    max_overlap_loss: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="share of that overlap that a new pose may lose",
    )
