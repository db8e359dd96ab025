"""A rendered dataset as a plugin of megloc-kapture, and what writers of layouts share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

from pydantic import Field

from megloc_kapture.io.files import write_bytes
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Options
from megloc_twins.options import SyntheticWorldOptions, stream

Item = TypeVar("Item")
OptionsT = TypeVar("OptionsT", bound=Options)


class SyntheticDataset(ABC, Generic[OptionsT]):
    """A dataset that is rendered from its options; group ``megloc_kapture.rendered_datasets``.

    Parameters
    ----------
    options : of the class's model ``Options``; its defaults unless given.
    """

    Options: ClassVar[type[Options]]
    version: ClassVar[int]
    """Raised when the same options give other files than before."""
    options: OptionsT

    def __init__(self, options: OptionsT | None = None) -> None:
        self.options = options or self.Options()  # type: ignore[assignment]

    @abstractmethod
    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        """Render it and write it below ``root``; returns what it holds.

        The bytes depend on the options alone. Processes of ``work`` have to see the same files.

        Raises
        ------
        OutputError : something cannot be written.
        """


class ModelTwinOptions(Options):
    """Options of a twin that is published with a sparse model."""

    seed: int = Field(default=0, ge=0, description="every random choice hangs on it")
    supersampling: int = Field(default=2, ge=1, le=4, description="samples per px and axis")
    points_per_image: int = Field(
        default=100, ge=1, description="points of the sparse models that are drawn in each image"
    )
    night_exposure: float = Field(
        default=1.0, gt=0, description="light that reaches the sensor at night, relative"
    )
    jpeg_quality: int = Field(default=92, ge=1, le=100, description="quality of JPEG images")
    model_features: bool = Field(
        default=False,
        description="sparse models of SIFT of the images, not of exact points, with their database",
    )

    def rendered_world(self, num_places: int, width: int, height: int) -> SyntheticWorldOptions:
        """The world that the twin's images are taken in."""
        return SyntheticWorldOptions(
            num_places=num_places,
            width=width,
            height=height,
            **self.model_dump(include={"seed", "supersampling", "night_exposure", "jpeg_quality"}),
        )


def shuffled(items: Sequence[Item], seed: int, *labels: str) -> list[Item]:
    """The items in no order, as in published files; the same for the same labels."""
    return [items[index] for index in stream(seed, *labels).permutation(len(items))]


def write_lines(
    path: Path, lines: Sequence[str], *, line_end: str = "\n", last_line_ends: bool = True
) -> None:
    """Write a text file; raises OutputError."""
    write_bytes(path, (line_end.join(lines) + line_end * last_line_ends).encode())
