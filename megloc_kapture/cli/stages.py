"""Commands of local features, matches and maps; each writes what any kapture tool can read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Force, Input, Linked, Output, Reading
from megloc_kapture.cli.stage_command import StageCommand, only_type
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs
from megloc_kapture.pipeline.executors import available_cores
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import MATCHERS
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.triangulation import triangulate_map

MAP = "map"

Inputs = Annotated[tuple[Path, ...], tyro.conf.arg(aliases=["-i"]), tyro.conf.UseAppendAction]


@dataclass(frozen=True, kw_only=True)
class ExtractLocal(Linked, StageCommand):
    """Extract local features of all images of kapture folders."""

    uses = ("local_features", "mask_margin_px")

    input: Inputs = ()
    """Kapture folder; may be repeated (map and queries)."""
    output: Output
    """Features folder: local_features/T/{keypoints,descriptors}."""
    features: tuple[str, ...] = ()
    """Extractor plugins; those of the preset unless given."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        if not self.input:
            raise OptionError("no kapture folder given; use -i")
        folders = [self.kapture(path) for path in self.input]
        options = self.options(self.named("local_features", self.features))
        extractors = options.make_extractors()
        with self.features_folder(self.output, force=self.force) as (out, work):
            for extractor in extractors:
                counts = extract_local_features(
                    folders,
                    extractor,
                    out,
                    mask_margin_px=options.mask_margin_px,
                    work=work,
                )
                console.say(
                    f"{extractor.name}: {counts['keypoints']} keypoints, {counts['images']} images"
                    + (
                        f"; masks of {counts['images_with_mask']} images removed "
                        f"{counts['keypoints_masked']}"
                        if "images_with_mask" in counts
                        else ""
                    )
                    + (
                        f"; {counts['images_reduced']} images were reduced meanwhile "
                        "(max_megapixels)"
                        if "images_reduced" in counts
                        else ""
                    )
                )
        return 0


@dataclass(frozen=True, kw_only=True)
class Match(Reading, StageCommand):
    """Match and verify image pairs; with known poses within a map, else by a two-view model."""

    uses = ("local_features", "matching", "verification")

    input: Input
    """Kapture folder of the map."""
    query: Path | None = None
    """Kapture folder of the queries; without it the pairs are within the map."""
    pairs: Path
    """Pairs file."""
    output: Output
    """Features folder: local_features/T/matches."""
    features: str | None = None
    """Type of local features; needed where there are several."""
    matcher: str | None = None
    """Matcher plugin; the preset's unless given."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        mapping = self.kapture(self.input)
        local_type = only_type(mapping, "descriptors", self.features)
        changes: dict[str, object] = {"matching": {"name": self.matcher}} if self.matcher else {}
        between = "mapping_verification" if self.query is None else "query_verification"
        options = self.options(changes, also=(between,))
        # --matcher also where the preset has another one for this type
        chosen = options.matching if self.matcher else options.matching_of(local_type)
        self.check_computes(chosen)
        matcher = load_plugin(MATCHERS, chosen.name, chosen.options)
        first, verification = mapping, options.verify_mapping()
        if self.query is not None:
            first = self.kapture(self.query)
            mapping.check_features_apart(first)
            verification = options.verify_queries()
        pairs = read_pairs(self.pairs)
        _check_images_of(pairs, first, mapping, self.pairs)
        with self.features_folder(self.output, force=self.force) as (out, work):
            counts = match_pairs(
                first,
                mapping,
                pairs,
                local_type,
                matcher,
                verification,
                out,
                work=work,
            )
        console.say(f"{counts['matches']} matches in {counts['pairs_with_matches']} pairs")
        return 0


@dataclass(frozen=True, kw_only=True)
class Triangulate(Reading, StageCommand):
    """Triangulate verified matches of images with known poses into a kapture map."""

    uses = ("triangulation",)

    input: Input
    """Kapture folder with images and poses."""
    output: Output
    """Kapture folder of the map."""
    pairs: Path | None = None
    """Use the matches of these pairs only."""
    features: tuple[str, ...] = ()
    """Types of local features, each with its own points; needed where there are several."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        mapping = self.kapture(self.input)
        local_types = [only_type(mapping, "matches", asked) for asked in self.features or (None,)]
        pairs = None if self.pairs is None else read_pairs(self.pairs)
        if pairs is not None and self.pairs is not None:
            _check_images_of(pairs, mapping, mapping, self.pairs)
        with self.staged(self.output, MAP, force=self.force) as (out, work):
            counts = triangulate_map(
                mapping,
                mapping,
                local_types,
                out,
                self.options().triangulation,
                pairs=pairs,
                num_threads=self.workers or available_cores(),
                work=work,
            )
        for type_name in sorted(set(local_types)) if len(set(local_types)) > 1 else ():
            points, seen = counts[f"points_{type_name}"], counts[f"observations_{type_name}"]
            console.say(f"{type_name}: {points} points, {seen} observations")
        console.say(f"{counts['points']} points, {counts['observations']} observations")
        return 0


def _check_images_of(
    pairs: Sequence[ImagePair], first: KaptureFolder, second: KaptureFolder, path: Path
) -> None:
    known_first = set(first.read().image_names())
    known_second = set(second.read().image_names())
    for pair in pairs:
        if pair.query not in known_first:
            raise DataError(f"no image {pair.query} in {first.root}", path=path)
        if pair.map not in known_second:
            raise DataError(f"no image {pair.map} in {second.root}", path=path)
