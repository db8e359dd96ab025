"""Which images of RobotCar Seasons are imported, and as what."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from pydantic import Field, model_validator

from megloc_kapture.datasets.grammars.robotcar_files import ImageKey
from megloc_kapture.datasets.robotcar_layout import SCORED_CAMERA
from megloc_kapture.datasets.robotcar_queries import Queries
from megloc_kapture.datasets.robotcar_reference import ModelChoice, Reference
from megloc_kapture.values import Options


class RobotCarOptions(Options):
    """What is imported, and from which of the published models."""

    version: Literal["auto", 1, 2] = Field(
        default="auto", description="of the benchmark; auto is 2 where its test list is there"
    )
    model: ModelChoice = Field(
        default="auto", description="that the map's poses come from; auto prefers the merged one"
    )
    queries: Literal["all", "train", "test"] = Field(
        default="all", description="version 2: import only the moments of one of its lists"
    )
    train_as_map: bool = Field(
        default=False, description="version 2: its training images are map images, not queries"
    )
    reference_model: bool = Field(
        default=False, description="import the model's points as a kapture map of SIFT features"
    )
    location_prior: bool = Field(
        default=True,
        description="a query is matched with map images of its location and camera only, which "
        "the benchmark permits to know; false: with all",
    )

    @model_validator(mode="after")
    def _usable(self) -> RobotCarOptions:
        if self.train_as_map and self.queries == "train":
            raise ValueError("train_as_map leaves nothing for queries=train")
        return self


@dataclass(frozen=True, eq=False)
class Selection:
    """The images of an import, as they are on disk.

    Parameters
    ----------
    version : of the benchmark, 1 or 2.
    reference, queries : all that the models and lists say.
    map_images, train_images, query_images : image -> its path below ``images/``: those of the
        reference traversal, version 2's training images where they join the map, the queries.
        They keep the order of the models and lists.
    """

    version: int
    reference: Reference
    queries: Queries
    map_images: Mapping[ImageKey, str]
    train_images: Mapping[ImageKey, str]
    query_images: Mapping[ImageKey, str]

    def images(self) -> dict[ImageKey, str]:
        """All images."""
        return {**self.map_images, **self.train_images, **self.query_images}

    def is_scored(self, query: ImageKey) -> bool:
        """Whether the benchmark, or the half of it that is public, asks for a query's pose."""
        if self.version == 1:
            return query.camera == SCORED_CAMERA
        return query in self.queries.test or query in self.queries.train


def select(
    options: RobotCarOptions,
    version: int,
    reference: Reference,
    queries: Queries,
    *,
    cameras: Collection[str],
    find: Callable[[ImageKey], str | None],
) -> Selection:
    """Choose the images of these cameras.

    Parameters
    ----------
    find : path of an image below ``images/``; None where it is not there.
    """
    wanted: Iterable[ImageKey] = queries.locations
    if options.queries != "all":
        listed = queries.train if options.queries == "train" else queries.test
        wanted = _of_moments(wanted, listed)
    train: Iterable[ImageKey] = ()
    if options.train_as_map:
        train = queries.train
        # neither are the other cameras of these moments queries: the map knows where they were
        taken = set(_of_moments(queries.locations, train))
        wanted = [image for image in wanted if image not in taken]

    def found(images: Iterable[ImageKey]) -> dict[ImageKey, str]:
        paths = ((image, find(image)) for image in images if image.camera in cameras)
        return {image: path for image, path in paths if path is not None}

    return Selection(
        version,
        reference,
        queries,
        map_images=found(reference.poses),
        train_images=found(train),
        query_images=found(wanted),
    )


def _of_moments(images: Iterable[ImageKey], others: Iterable[ImageKey]) -> list[ImageKey]:
    """Those of ``images`` that were taken at the moments of ``others``, by whichever camera."""
    moments = {(other.condition, other.timestamp) for other in others}
    return [image for image in images if (image.condition, image.timestamp) in moments]
