"""Options of the synthetic world, and the random streams that hang on its seed."""

from __future__ import annotations

from typing import Literal
from zlib import crc32

import numpy as np
from pydantic import Field

from megloc_kapture.values import Options


class SyntheticWorldOptions(Options):
    """Contents of the synthetic world, and how its images are taken.

    The defaults are the world that ``make eval`` localizes in: hard enough that retrieval is
    often wrong and night is worse than day, easy enough that day queries localize.
    """

    seed: int = Field(default=0, ge=0, description="every random choice hangs on it")
    num_places: int = Field(default=4, ge=1, description="places, at least 60 m apart")
    stations_per_place: int = Field(
        default=9, ge=3, description="stops of the mapping rig in each place"
    )
    day_queries: int = Field(default=24, ge=0, description="query images by day, all places")
    night_queries: int = Field(default=24, ge=0, description="query images at night, all places")
    width: int = Field(default=640, ge=64, description="image width in px")
    height: int = Field(default=480, ge=48, description="image height in px")
    supersampling: int = Field(default=2, ge=1, le=4, description="samples per px and axis")
    repetition: float = Field(
        default=0.6,
        ge=0,
        le=1,
        description="share of posters, doors and windows that every place has in common",
    )
    unique_texture: float = Field(
        default=1.0, ge=0, description="strength of the dirt that makes each surface unique"
    )
    moving_objects: int = Field(
        default=2, ge=0, description="people and cars around each stop of the rig or query"
    )
    bonnet: bool = Field(default=True, description="the rig's front camera sees the car's bonnet")
    distortion: bool = Field(
        default=True, description="query cameras have radial distortion (SIMPLE_RADIAL)"
    )
    night_exposure: float = Field(
        default=1.0, gt=0, description="light that reaches the sensor at night, relative"
    )
    image_format: Literal["jpg", "png"] = Field(default="jpg", description="file type of images")
    jpeg_quality: int = Field(default=92, ge=1, le=100, description="quality of JPEG images")
    depth: bool = Field(default=False, description="write depth maps of the mapping images")
    masks: bool = Field(default=False, description="write masks that leave the bonnet out")


def stream(seed: int, *labels: str | int) -> np.random.Generator:
    """The random stream of one thing in the world, named by ``labels``.

    Streams of different names are independent, so that adding a query or a poster does not
    change the rest of the world.
    """
    return np.random.default_rng([seed, crc32("/".join(map(str, labels)).encode())])
