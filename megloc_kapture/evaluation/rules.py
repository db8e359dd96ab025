"""What results are measured by: conditions, scored images, thresholds, frame, names and pairs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.evaluation.thresholds import Threshold, thresholds_from_pairs
from megloc_kapture.io.challenge_tables import (
    RelocalizationPair,
    read_names,
    read_relocalization,
)
from megloc_kapture.io.side_tables import (
    ImageGroup,
    Protocol,
    World,
    read_groups,
    read_protocol,
    read_world,
)

_DEFAULT_GROUP = ImageGroup()


@dataclass(frozen=True)
class Rules:
    """A benchmark's rules, from the workspace's side tables or from a dataset's name.

    Attributes
    ----------
    protocol : thresholds, conditions and pools, and who knows the truth.
    groups : image -> condition and whether it is scored.
    world : between the local frame of the truth and the official one of pose files.
    names : image -> its name in a pose file, in the order of the challenge's list.
    pairs : what an MLAD challenge asks for.
    """

    protocol: Protocol = Protocol()
    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    world: World = World()
    names: Mapping[str, str] = field(default_factory=dict)
    pairs: tuple[RelocalizationPair, ...] = ()

    def thresholds(self) -> tuple[Threshold, ...]:
        """The protocol's thresholds."""
        return thresholds_from_pairs(self.protocol.thresholds)

    def scored(self, images: Iterable[str]) -> set[str]:
        """Those of ``images`` that the benchmark counts."""
        return {i for i in images if self.groups.get(i, _DEFAULT_GROUP).scored}

    def conditions(self, images: Iterable[str]) -> dict[str, str]:
        """Image -> condition.

        Where no side table has groups, a folder in the image's path that is called like a condition
        of the protocol is its condition (``query/night/x.jpg``).
        """
        if self.groups:
            return {i: self.groups[i].condition for i in images if i in self.groups}
        known = set(self.protocol.conditions)
        found = {}
        for image in images:
            parts = [part for part in PurePosixPath(image).parts[:-1] if part in known]
            if len(parts) == 1:
                found[image] = parts[0]
        return found


def read_rules(side_tables: Path | str | None = None, dataset: str | None = None) -> Rules:
    """Rules of a workspace, of a dataset by name, or the default.

    Parameters
    ----------
    side_tables : the workspace's ``megloc/`` folder.
    dataset : takes the place of the workspace's protocol; groups and frame stay the workspace's.

    Raises
    ------
    DataError : a table is broken.
    OptionError : an unknown dataset.
    """
    named = None if dataset is None else protocol_of(dataset)
    if side_tables is None:
        return Rules(protocol=named or Protocol())
    return Rules(
        protocol=named or read_protocol(side_tables),
        groups=read_groups(side_tables),
        world=read_world(side_tables),
        names=read_names(side_tables),
        pairs=tuple(read_relocalization(side_tables)),
    )
