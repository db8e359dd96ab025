"""The stages one by one: each reads kapture folders and writes what any kapture tool can read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import (
    Choosing,
    Common,
    Force,
    Input,
    Output,
    Working,
    existing,
    side_tables_beside,
)
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.kapture_store import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.outputs import staged_output
from megloc_kapture.pipeline.executors import available_cores, open_executor, single_threaded
from megloc_kapture.pipeline.options import PipelineOptions
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, options_of_preset
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS, load_plugin
from megloc_kapture.stages.global_vlad import extract_vlad, vlad_type
from megloc_kapture.stages.image_pairs import PairingMethod, pair_map_images, pair_queries
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.restrictions import UNRESTRICTED, Restrictions
from megloc_kapture.stages.triangulation import triangulate_map

FEATURES, MAP = "features", "map"

Inputs = Annotated[tuple[Path, ...], tyro.conf.arg(aliases=["-i"]), tyro.conf.UseAppendAction]
FeaturesDirs = Annotated[tuple[Path, ...], tyro.conf.UseAppendAction]


@dataclass(frozen=True, kw_only=True)
class _StageCommand(Choosing, Working, Common):
    def options(self, changes: dict[str, object] | None = None) -> PipelineOptions:
        """The preset's options, with what the flags change."""
        return options_of_preset(
            self.preset or DEFAULT_PRESET, changes=changes, assignments=self.set
        )

    @contextmanager
    def features_folder(
        self, output: Path, *, force: bool
    ) -> Iterator[tuple[Path, Executor | None]]:
        """Where to write features or matches, and what to work with."""
        with (
            single_threaded(),
            staged_output(output, kind=FEATURES, force=force) as out,
            open_executor(self.executor, self.workers) as executor,
        ):
            yield out, executor


@dataclass(frozen=True, kw_only=True)
class ExtractLocal(_StageCommand):
    """Extract local features of all images of kapture folders."""

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
        folders = _folders(self.input)
        options = self.options()
        chosen = {one.name: one.options for one in options.local_features}
        names = self.features or tuple(chosen)
        extractors = [load_plugin(LOCAL_FEATURES, name, chosen.get(name, {})) for name in names]
        with self.features_folder(self.output, force=self.force) as (out, executor):
            for extractor in extractors:
                counts = extract_local_features(
                    folders,
                    extractor,
                    out,
                    mask_margin_px=options.mask_margin_px,
                    executor=executor,
                    track=console.track,
                )
                console.say(
                    f"{extractor.name}: {counts['keypoints']} keypoints, {counts['images']} images"
                    + (
                        f"; masks of {counts['images_with_mask']} images removed "
                        f"{counts['keypoints_masked']}"
                        if "images_with_mask" in counts
                        else ""
                    )
                )
        return 0


@dataclass(frozen=True, kw_only=True)
class ExtractGlobal(_StageCommand):
    """Train a VLAD vocabulary on a map and describe the images of map and queries with it."""

    input: Input
    """Kapture folder of the map: its descriptors train the vocabulary."""
    query: tuple[Path, ...] = ()
    """Kapture folders of queries to describe as well."""
    output: Output
    """Features folder: global_features/T/global_features."""
    features: tuple[str, ...] = ("vlad",)
    """Global features: vlad."""
    features_dir: FeaturesDirs = ()
    """Features folder with the local features; may be repeated."""
    local_type: str | None = None
    """Local features to aggregate; needed where there are several types."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        unknown = sorted(set(self.features) - {"vlad"})
        if unknown:
            raise OptionError(f"unknown global features {unknown[0]!r}; known: vlad")
        mapping = KaptureFolder(self.input, features_dirs=existing(self.features_dir))
        queries = [KaptureFolder(q, features_dirs=existing(self.features_dir)) for q in self.query]
        local_type = _only_type(mapping, "descriptors", self.local_type)
        with self.features_folder(self.output, force=self.force) as (out, executor):
            counts = extract_vlad(
                mapping,
                [mapping, *queries],
                local_type,
                out,
                self.options().vlad,
                executor=executor,
                track=console.track,
            )
            console.say(f"{vlad_type(local_type)}: {counts['images']} images")
        return 0


@dataclass(frozen=True, kw_only=True)
class PairsMapping(_StageCommand):
    """Choose which images of a map are matched with each other."""

    input: Input
    """Kapture folder with poses."""
    output: Output
    """Pairs file."""
    by: tuple[PairingMethod, ...] = ("retrieval",)
    """How; several methods are united."""
    topk: int | None = None
    """Most similar images per image (retrieval)."""
    covisibility_map: Path | None = None
    """Kapture map of the same images, for the points they share; the input's own without it."""
    features_dir: FeaturesDirs = ()
    """Features folder with the global features; may be repeated."""
    global_type: str | None = None
    """Global features; needed where there are several types."""
    force: Force = False
    """Overwrite the pairs file."""

    def run(self) -> int:
        """Run it."""
        mapping = KaptureFolder(self.input, features_dirs=existing(self.features_dir))
        changes: dict[str, object] = {"by": self.by}
        if self.topk is not None:
            changes["top_k"] = self.topk
        options = self.options({"mapping_pairs": changes}).mapping_pairs
        covisible = self.covisibility_map
        if covisible is not None and not options.needs_points():
            raise OptionError("--covisibility-map is for --by covisibility, or poses.min_overlap")
        global_type = None
        if "retrieval" in self.by:
            global_type = _only_type(mapping, "global_features", self.global_type)
        with single_threaded():
            pairs = pair_map_images(
                mapping,
                options,
                global_type=global_type,
                restrictions=_restrictions(self.input),
                covisible=None if covisible is None else KaptureFolder(covisible),
            )
        _write_pairs(self.output, pairs, force=self.force)
        self.console().say(f"{len(pairs)} pairs")
        return 0


@dataclass(frozen=True, kw_only=True)
class PairsQuery(_StageCommand):
    """Choose the map images each query is matched with."""

    input: Input
    """Kapture folder of the map."""
    query: Path
    """Kapture folder of the queries."""
    output: Output
    """Pairs file."""
    topk: int | None = None
    """Most similar map images per query."""
    features_dir: FeaturesDirs = ()
    """Features folder with the global features; may be repeated."""
    global_type: str | None = None
    """Global features; needed where there are several types."""
    exhaustive: bool = False
    """All map images for each query; for small maps."""
    force: Force = False
    """Overwrite the pairs file."""

    def run(self) -> int:
        """Run it."""
        mapping = KaptureFolder(self.input, features_dirs=existing(self.features_dir))
        query = KaptureFolder(self.query, features_dirs=existing(self.features_dir))
        changes: dict[str, object] = {"by": "exhaustive" if self.exhaustive else "retrieval"}
        if self.topk is not None:
            changes["top_k"] = self.topk
        options = self.options({"query_pairs": changes}).query_pairs
        global_type = None
        if not self.exhaustive:
            global_type = _only_type(mapping, "global_features", self.global_type)
        with single_threaded():
            pairs = pair_queries(
                mapping,
                query,
                options,
                global_type=global_type,
                restrictions=_restrictions(self.query),
            )
        _write_pairs(self.output, pairs, force=self.force)
        self.console().say(f"{len(pairs)} pairs")
        return 0


@dataclass(frozen=True, kw_only=True)
class Match(_StageCommand):
    """Match and verify image pairs; with known poses within a map, else by a two-view model."""

    input: Input
    """Kapture folder of the map."""
    query: Path | None = None
    """Kapture folder of the queries; without it the pairs are within the map."""
    pairs: Path
    """Pairs file."""
    output: Output
    """Features folder: local_features/T/matches."""
    features_dir: FeaturesDirs = ()
    """Features folder with the local features; may be repeated."""
    features: str | None = None
    """Type of local features; needed where there are several."""
    matcher: str | None = None
    """Matcher plugin; the preset's unless given."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        mapping = KaptureFolder(self.input, features_dirs=existing(self.features_dir))
        local_type = _only_type(mapping, "descriptors", self.features)
        changes: dict[str, object] = {"matching": {"name": self.matcher}} if self.matcher else {}
        options = self.options(changes)
        if self.matcher:  # also where the preset has another one for this type
            matcher = load_plugin(MATCHERS, self.matcher, options.matching.options)
        else:
            matcher = options.make_matcher(local_type)
        first, verification = mapping, options.verify_mapping()
        if self.query is not None:
            first = KaptureFolder(self.query, features_dirs=existing(self.features_dir))
            verification = options.verify_queries()
        pairs = read_pairs(self.pairs)
        _check_images_of(pairs, first, mapping, self.pairs)
        with self.features_folder(self.output, force=self.force) as (out, executor):
            counts = match_pairs(
                first,
                mapping,
                pairs,
                local_type,
                matcher,
                verification,
                out,
                executor=executor,
                track=console.track,
            )
        console.say(f"{counts['matches']} matches in {counts['pairs_with_matches']} pairs")
        return 0


@dataclass(frozen=True, kw_only=True)
class Triangulate(_StageCommand):
    """Triangulate verified matches of images with known poses into a kapture map."""

    input: Input
    """Kapture folder with images and poses."""
    output: Output
    """Kapture folder of the map."""
    pairs: Path | None = None
    """Use the matches of these pairs only."""
    features_dir: FeaturesDirs = ()
    """Features folder with local features and matches; may be repeated."""
    features: tuple[str, ...] = ()
    """Types of local features, each with its own points; needed where there are several."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        mapping = KaptureFolder(self.input, features_dirs=existing(self.features_dir))
        local_types = [_only_type(mapping, "matches", asked) for asked in self.features or (None,)]
        pairs = None if self.pairs is None else read_pairs(self.pairs)
        if pairs is not None and self.pairs is not None:
            _check_images_of(pairs, mapping, mapping, self.pairs)
        with staged_output(self.output, kind=MAP, force=self.force) as out:
            counts = triangulate_map(
                mapping,
                mapping,
                local_types,
                out,
                self.options().triangulation,
                pairs=pairs,
                num_threads=self.workers or available_cores(),
            )
        for type_name in sorted(set(local_types)) if len(set(local_types)) > 1 else ():
            points, seen = counts[f"points_{type_name}"], counts[f"observations_{type_name}"]
            console.say(f"{type_name}: {points} points, {seen} observations")
        console.say(f"{counts['points']} points, {counts['observations']} observations")
        return 0


def _restrictions(folder: Path) -> Restrictions:
    """Of the dataset whose tables lie beside a kapture folder; none where there are none."""
    tables = side_tables_beside(folder)
    return UNRESTRICTED if tables is None else Restrictions.read(tables)


def _folders(paths: Sequence[Path]) -> list[KaptureFolder]:
    if not paths:
        raise OptionError("no kapture folder given; use -i")
    return [KaptureFolder(path) for path in paths]


def _only_type(folder: KaptureFolder, kind: str, asked: str | None) -> str:
    types = folder.types(kind)  # type: ignore[arg-type]
    if asked is not None:
        if asked not in types:
            there = ", ".join(types) or "none"
            raise OptionError(f"{folder.root}: no {kind} of type {asked!r}; there are: {there}")
        return asked
    if len(types) != 1:
        raise OptionError(
            f"{folder.root}: "
            + (f"several types of {kind}, name one: {', '.join(types)}" if types else f"no {kind}")
            + ("" if types else "; give their folder with --features-dir")
        )
    return types[0]


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


def _write_pairs(path: Path, pairs: Sequence[ImagePair], *, force: bool) -> None:
    if path.exists() and not force:
        raise OptionError(f"{path} exists; -f overwrites it")
    write_pairs(path, pairs)
