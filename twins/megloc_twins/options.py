"""Rendered datasets: options, random streams that depend on the seed, and the base class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Generic, TypeVar
from zlib import crc32

import numpy as np
from numpy.random import Generator
from pydantic import Field

from megloc_kapture.io.files import write_bytes
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Options

Item = TypeVar("Item")
OptionsT = TypeVar("OptionsT", bound=Options)

JPEG_QUALITY = 92  # of all images


class TwinOptions(Options):
    """Options of every rendered dataset."""

    seed: int = Field(default=0, ge=0, description="seed of all random choices")
    supersampling: int = Field(default=2, ge=1, le=4, description="samples per pixel and axis")

    def world(self) -> SyntheticWorldOptions:
        names = SyntheticWorldOptions.model_fields.keys() & type(self).model_fields.keys()
        return SyntheticWorldOptions(**self.model_dump(include=names))

    def noise_seed(self, image: str) -> int:
        """Return the seed of an image's sensor noise."""
        return seed_of(self.seed, "noise", image.rsplit(".", 1)[0])


class SyntheticWorldOptions(TwinOptions):
    """Contents and images of the synthetic world.

    With the defaults, retrieval is often wrong and recall is lower at night than by day, but day
    queries are localized.
    """

    num_places: int = Field(default=4, ge=1, description="places, at least 60 m apart")
    stations_per_place: int = Field(default=9, ge=3, description="stops of the mapping rig")
    day_queries: int = Field(default=24, ge=0, description="query images by day, in total")
    night_queries: int = Field(default=24, ge=0, description="query images at night, in total")
    width: int = Field(default=640, ge=64, description="image width in px")
    height: int = Field(default=480, ge=48, description="image height in px")
    moving_objects: int = Field(default=2, ge=0, description="people and cars near a camera")
    depth: bool = Field(default=False, description="write depth maps of the mapping images")
    masks: bool = Field(default=False, description="write masks of the bonnet")


def stream(seed: int, *labels: str | int) -> Generator:
    """Return the generator of an object or choice with these ``labels``, independent of others."""
    return np.random.default_rng([seed, crc32("/".join(map(str, labels)).encode())])


def seed_of(seed: int, *labels: str | int) -> int:
    """Return the seed of an object with these ``labels``."""
    return int(stream(seed, *labels).integers(2**31))


class SyntheticDataset(ABC, Generic[OptionsT]):
    """A dataset rendered from its options; group ``megloc_kapture.rendered_datasets``."""

    Options: ClassVar[type[Options]]
    version: ClassVar[int]  # of the files; increase it when equal options give different files
    options: OptionsT

    def __init__(self, options: OptionsT | None = None) -> None:
        self.options = options or self.Options()  # type: ignore[assignment]

    @abstractmethod
    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        """Render the dataset, write it below ``root`` and return counts.

        The bytes depend on the options only. All processes of ``work`` must share a file system.
        """


def shuffled(items: Sequence[Item], seed: int, *labels: str) -> list[Item]:
    """Return the items in an order that depends on seed and labels, as in published files."""
    return [items[index] for index in stream(seed, *labels).permutation(len(items))]


def write_lines(
    path: Path, lines: Sequence[str], *, line_end: str = "\n", last_line_ends: bool = True
) -> None:
    write_bytes(path, (line_end.join(lines) + line_end * last_line_ends).encode())
