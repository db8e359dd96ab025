"""Stage: retrieval of map images by one or several global features."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import ImageGroup, read_groups, read_priors
from megloc_kapture.io.kapture import FeatureReader, KaptureFolder
from megloc_kapture.io.kapture.features import KaptureVectors
from megloc_kapture.retrieval.search import (
    Found,
    FusedSearch,
    FusionOptions,
    as_blocks,
    common_length,
)
from megloc_kapture.values import Options


@dataclass(frozen=True, eq=False)
class Restrictions:
    """Priors of the queries, and the coordinate frames of the map images.

    ``groups`` has each image's group. ``priors`` has the permitted map images, locations or frames
    of each query; others are unrestricted.
    """

    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @classmethod
    def read(cls, side_tables: Path) -> Restrictions:
        """Read from a workspace's ``megloc/`` folder; missing tables restrict nothing."""
        return cls(read_groups(side_tables), read_priors(side_tables))

    def frame(self, image: str) -> str:
        """Return the coordinate frame of a map image; ``""`` if there is only one."""
        group = self.groups.get(image)
        return "" if group is None else group.frame

    def frames(self, images: Sequence[str]) -> list[NDArray[np.int64]]:
        """Return indices into ``images`` by frame, frames sorted by name."""
        members: dict[str, list[int]] = {}
        for position, image in enumerate(images):
            members.setdefault(self.frame(image), []).append(position)
        return [np.array(members[name], np.int64) for name in sorted(members)]

    def pools(
        self, queries: Sequence[str], images: Sequence[str]
    ) -> Iterator[tuple[list[int], NDArray[np.int64]]]:
        """Group queries by permitted images.

        Yield indices into ``queries`` and sorted indices into ``images``, int64 (M,); M may be 0.
        """
        together: dict[tuple[str, ...] | None, list[int]] = {}
        for position, query in enumerate(queries):
            prior = self.priors.get(query)
            together.setdefault(None if prior is None else tuple(prior), []).append(position)
        members = self._members(images) if set(together) != {None} else {}
        for permitted, positions in together.items():
            if permitted is None:
                yield positions, np.arange(len(images))
                continue
            found = [position for name in permitted for position in members.get(name, ())]
            yield positions, np.unique(np.array(found, dtype=np.int64))

    def _members(self, images: Sequence[str]) -> dict[str, list[int]]:
        members: dict[str, list[int]] = {}
        for position, image in enumerate(images):
            group = self.groups.get(image, ImageGroup())
            for name in {image, group.location, group.frame} - {""}:
                members.setdefault(name, []).append(position)
        return members


UNRESTRICTED = Restrictions()


Vectors = KaptureVectors | NDArray[np.float32]  # unit rows
_QUERY_ELEMENTS = 1 << 27  # query vector elements in memory: 512 MiB of float32


class QueryPairsOptions(Options):
    by: Literal["retrieval", "exhaustive"] = Field(
        default="retrieval", description="the most similar map images, or all"
    )
    top_k: int = Field(default=50, gt=0, description="number of most similar map images per query")


@dataclass(frozen=True)
class Retrieval:
    """Global features, by kapture type name, and their fusion weights; equal if empty."""

    types: tuple[str, ...]
    weights: tuple[float, ...] = ()
    fusion: FusionOptions = field(default_factory=FusionOptions)

    def readers(self, folder: KaptureFolder) -> list[FeatureReader]:
        return [folder.global_features(name) for name in self.types]

    def rank(
        self,
        queries: Sequence[Vectors],
        database: Sequence[Vectors],
        top_k: int,
    ) -> Found:
        """Find the most similar database rows: indices and scores (Q, at most ``top_k``).

        ``queries`` and ``database`` hold unit rows by type, read in parts.
        """
        search = FusedSearch(top_k, self.fusion, self.weights or None)
        asked = [as_blocks(source) for source in queries]
        total, width = common_length(asked), sum(one.dimension for one in asked)
        step = max(1, _QUERY_ELEMENTS // max(width, 1))
        found = []
        for start in range(0, total, step) or (0,):
            rows = [source.read(start, min(start + step, total)) for source in asked]
            found.append(search.find(rows, database))
        indices, scores = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
        return indices, scores


def vectors_of(readers: Sequence[FeatureReader], images: Sequence[str]) -> list[KaptureVectors]:
    """Return lazily read unit vectors of the images by type."""
    for reader in readers:
        missing = [image for image in images if image not in reader]
        if missing:
            raise DataError(
                f"{len(missing)} images have no global feature of type {reader.type_name}, "
                f"the first is {missing[0]}"
            )
    return [KaptureVectors(reader, images) for reader in readers]


def most_similar(
    queries: Sequence[Vectors],
    database: Sequence[Vectors],
    permitted: NDArray[np.int64],
    retrieval: Retrieval,
    top_k: int,
) -> Found:
    """Return indices of the most similar images, best first, and scores: (Q, K), -1 for none.

    Parameters
    ----------
    queries, database : unit vectors (Q, D) and (M, D) by type.
    permitted : indices (M,) of the database's images.
    """
    index, scores = retrieval.rank(queries, database, top_k)
    return np.where(index >= 0, permitted[np.maximum(index, 0)], -1), scores
