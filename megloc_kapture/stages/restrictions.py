"""What a dataset's side tables permit: whom a query may be matched with, and what never mixes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.dataset_tables import ImageGroup, read_groups, read_priors


@dataclass(frozen=True, eq=False)
class Restrictions:
    """Priors of the queries, and the coordinate frames of the map's images.

    Parameters
    ----------
    groups : image -> its group; of the map's images, frame and location count.
    priors : query -> names of map images, locations or frames it may be matched with. A query
        that is not in it may be matched with everything.
    """

    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @classmethod
    def read(cls, side_tables: Path) -> Restrictions:
        """From a workspace's ``megloc/`` folder; absent tables restrict nothing.

        Raises
        ------
        DataError : a broken table.
        """
        return cls(read_groups(side_tables), read_priors(side_tables))

    def frame(self, image: str) -> str:
        """The coordinate frame of a map image; ``""`` where there is only one."""
        group = self.groups.get(image)
        return "" if group is None else group.frame

    def frames(self, images: Sequence[str]) -> list[NDArray[np.int64]]:
        """Positions in ``images`` by frame, frames in order of their names."""
        members: dict[str, list[int]] = {}
        for position, image in enumerate(images):
            members.setdefault(self.frame(image), []).append(position)
        return [np.array(members[name], np.int64) for name in sorted(members)]

    def pools(
        self, queries: Sequence[str], images: Sequence[str]
    ) -> Iterator[tuple[list[int], NDArray[np.int64]]]:
        """Queries that may be matched with the same images, and these images.

        Yields
        ------
        Positions in ``queries``, and sorted positions in ``images``, int64 (M,); every query
        once. M is 0 where nothing of what a prior permits is in the map.
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
