"""Commands for single stages: images, features, pairs, matches, points, and plugin stages.

Built-in commands write plain kapture data; a plugin stage runs in a workspace.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from megloc_kapture.cli.common import (
    AllowedLinks,
    Choosing,
    Computing,
    Folders,
    Force,
    Input,
    Inputs,
    Output,
    Overwrite,
    Reading,
    Texts,
    Working,
    kapture_map,
)
from megloc_kapture.errors import OptionError, check_option, require
from megloc_kapture.io.dataset_tables import read_tables_of, unit_of, write_unit
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.kapture.features import features_dir_hint
from megloc_kapture.io.output_folders import check_new_file
from megloc_kapture.matching.verification import KnownPoseOptions
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.plan import Workspace, run_plan
from megloc_kapture.pipeline.presets import (
    DEFAULT_PRESET,
    options_of_preset,
    options_with,
    parse_assignments,
)
from megloc_kapture.plugin_loading import load_chosen, load_plugin, plugin_class
from megloc_kapture.plugins import MATCHERS, STAGES, chosen_by_name
from megloc_kapture.retrieval.search import FusionMethod
from megloc_kapture.stages.global_features import extract_global_features, extract_vlad, vlad_type
from megloc_kapture.stages.image_pairs import (
    PairingMethod,
    Retrieval,
    pair_map_images,
    pair_queries,
)
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import triangulate_map
from megloc_kapture.stages.matches import check_given_poses, match_pairs
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.preprocessing import PreprocessingOptions, preprocess_images
from megloc_kapture.stages.reranking import RerankingOptions, reranked
from megloc_kapture.stages.stage import counts_text

_log = logging.getLogger(__name__)

PREPROCESSED, FEATURES, MAP = "preprocessed", "features", "map"


def _named(preset: str | None, key: str, names: Sequence[str]) -> dict[str, object]:
    """Return changes that select plugins by name, with the preset's settings for them."""
    known = getattr(options_of_preset(preset or DEFAULT_PRESET), key)
    return {key: chosen_by_name(known, names)} if names else {}


def only_type(folder: KaptureFolder, kind: str, asked: str | None) -> str:
    """Return the requested type, or the only type of a kind."""
    types = folder.types(kind)  # type: ignore[arg-type]
    present = ", ".join(types)
    if asked in types or (asked is None and len(types) == 1):
        return asked or types[0]
    if asked is not None:
        reason = f"no {kind} of type {asked!r}; there are: {present or 'none'}"
    elif types:
        reason = f"several types of {kind}, choose one: {present}"
    else:
        reason = f"no {kind}; {features_dir_hint(kind)}"  # type: ignore[arg-type]
    raise OptionError(f"{folder.root}: {reason}")


@dataclass(frozen=True, kw_only=True)
class ExtractLocal(Choosing, Working):
    """Extract local features from all images of kapture folders."""

    allow_links_below: AllowedLinks = ()
    input: Inputs = ()
    """Kapture folder; may be repeated (map and queries)."""
    output: Output
    """Features folder: local_features/T/{keypoints,descriptors}."""
    features: tuple[str, ...] = ()
    """Extractor plugins; if omitted, the preset's."""
    force: Force = False

    def run(self) -> None:
        check_option(self.input, "no kapture folder given; use -i")
        folders = [kapture_map(path) for path in self.input]
        options = self.options(_named(self.preset, "local_features", self.features))
        extractors = options.make_extractors()
        with self.staged(self.output, FEATURES, force=self.force, adds=True) as (out, work):
            for extractor in extractors:
                counts = extract_local_features(
                    folders, extractor, out, mask_margin_px=options.mask_margin_px, work=work
                )
                self.say(f"{extractor.name}: {counts_text(counts)}")


@dataclass(frozen=True, kw_only=True)
class Match(Reading, Choosing, Working):
    """Match image pairs and verify the matches: by the known poses of map images, or by two-view
    geometry for queries."""

    input: Input
    """Kapture folder of the map."""
    query: Path | None = None
    """Kapture folder of the queries; if omitted, both images of a pair are map images."""
    pairs: Path
    """Pairs file."""
    output: Output
    """Features folder: local_features/T/matches."""
    features: str | None = None
    """Type of local features; required if several exist."""
    matcher: str | None = None
    """Matcher plugin; if omitted, the preset's."""
    force: Overwrite = False
    """Write into a non-empty folder, and accept poses that contradict the matches."""

    def run(self) -> None:
        mapping = self.kapture_map(self.input)
        local_type = only_type(mapping, "descriptors", self.features)
        changes: dict[str, object] = {"matching": {"name": self.matcher}} if self.matcher else {}
        options = self.options(changes)
        # --matcher applies even if the preset has another matcher for this type of features
        chosen = options.matching if self.matcher else options.matching_of(local_type)
        matcher = load_chosen(MATCHERS, chosen, options.placement)
        first, verification = mapping, options.verify_mapping()
        if self.query is not None:
            first, verification = self.kapture(self.query), options.verify_queries()
            mapping.check_features_apart(first)
        pairs = _read_pairs_of(self.pairs, first, mapping)
        if isinstance(verification, KnownPoseOptions):
            self._check_poses(mapping, pairs)
        with self.staged(self.output, FEATURES, force=self.force, adds=True) as (out, work):
            if self.query is None and isinstance(verification, KnownPoseOptions):
                check_given_poses(mapping, pairs, local_type, matcher, work)
            counts = match_pairs(
                first, mapping, pairs, local_type, matcher, verification, out, work=work
            )
        self.say(f"{counts['matches']} matches in {counts['pairs_with_matches']} pairs")

    def _check_poses(self, mapping: KaptureFolder, pairs: Sequence[ImagePair]) -> None:
        posed = mapping.read().poses().keys()
        unposed = sum(not {pair.query, pair.map} <= posed for pair in pairs)
        message = (
            f"{unposed} of {len(pairs)} pairs in {self.pairs} have an image without a pose and "
            f"cannot be verified by poses; --query FOLDER (which may be {self.input}) verifies "
            "them by two-view geometry"
        )
        require(not pairs or unposed < len(pairs), message, path=mapping.root)
        if unposed:
            _log.warning("%s: %s", mapping.root, message)


@dataclass(frozen=True, kw_only=True)
class Triangulate(Reading, Choosing, Working):
    """Triangulate verified matches of images with known poses into a kapture map."""

    input: Input
    """Kapture folder with images and poses."""
    output: Output
    """Kapture folder of the map."""
    pairs: Path | None = None
    """Use the matches of these pairs only."""
    features: tuple[str, ...] = ()
    """Types of local features, each with separate points; required if several exist."""
    force: Force = False

    def run(self) -> None:
        mapping = self.kapture_map(self.input)
        local_types = [only_type(mapping, "matches", asked) for asked in self.features or (None,)]
        pairs = None if self.pairs is None else _read_pairs_of(self.pairs, mapping, mapping)
        with self.staged(self.output, MAP, force=self.force) as (out, work):
            counts = triangulate_map(
                mapping,
                local_types,
                out,
                self.options().triangulation,
                pairs=pairs,
                num_threads=work.num_threads,
            )
            write_unit(out, unit_of(mapping.root))
        self.say(counts_text(counts))


def _read_pairs_of(path: Path, first: KaptureFolder, second: KaptureFolder) -> list[ImagePair]:
    """Read pairs and check that their images exist in the two folders."""
    pairs = read_pairs(path)
    known_first, known_second = (set(f.read().image_names()) for f in (first, second))
    for pair in pairs:
        require(pair.query in known_first, f"no image {pair.query} in {first.root}", path=path)
        require(pair.map in known_second, f"no image {pair.map} in {second.root}", path=path)
    return pairs


@dataclass(frozen=True, kw_only=True)
class ExtractGlobal(Reading, Choosing, Working):
    """Compute global features of all images: VLAD trained on the map, or networks."""

    input: Input
    """Kapture folder of the map; VLAD is trained on its descriptors."""
    query: Folders = ()
    """Kapture folder of queries, which also get global features; may be repeated."""
    output: Output
    """Features folder: global_features/T/global_features."""
    features: tuple[str, ...] = ()
    """Global features: vlad, or plugins; if omitted, the preset's."""
    local_type: str | None = None
    """Local features that VLAD aggregates; required if several types exist."""
    force: Force = False

    def run(self) -> None:
        options = self.options(_named(self.preset, "global_features", self.features))
        folders = [self.kapture_map(self.input), *map(self.kapture, self.query)]
        extractors = {
            choice.name: choice.make(options.placement)
            for choice in options.global_features
            if not choice.is_vlad
        }
        with self.staged(self.output, FEATURES, force=self.force, adds=True) as (out, work):
            for choice in options.global_features:
                if choice.is_vlad:
                    vlad = choice.vlad_options()
                    asked = self.local_type or vlad.local_type
                    local_type = only_type(folders[0], "descriptors", asked)
                    type_name = vlad_type(local_type)
                    count = extract_vlad(folders[0], folders, local_type, out, vlad, work=work)
                else:
                    extractor = extractors[choice.name]
                    type_name = extractor.name
                    count = extract_global_features(folders, extractor, out, work=work)
                self.say(f"{type_name}: {count} images")


@dataclass(frozen=True, kw_only=True)
class PairsMapping(Reading, Choosing, Working):
    """Choose pairs of map images to match."""

    input: Input
    """Kapture folder with poses."""
    output: Output
    """Pairs file."""
    by: tuple[PairingMethod, ...] = ("retrieval",)
    """Pairing method; the pairs of several methods are combined."""
    topk: int | None = None
    """Number of most similar images per image (retrieval)."""
    covisibility_map: Path | None = None
    """Kapture map of the same images; its points define covisibility. If omitted, the input."""
    features: tuple[str, ...] = ()
    """Types of global features; several types are fused. Required if several exist."""
    fusion: FusionMethod | None = None
    """Fusion of several types; if omitted, the preset's."""
    force: Overwrite = False
    """Overwrite the pairs file."""

    def run(self) -> None:
        check_new_file(self.output, force=self.force)
        mapping = self.kapture_map(self.input)
        chosen = self.options({"mapping_pairs": _changes(self.by, self.topk)})
        options = chosen.mapping_pairs
        covisible = self.covisibility_map
        retrieval = None
        if "retrieval" in self.by:
            retrieval = _retrieval(mapping, self.features, self.fusion, chosen)
        with single_threaded():
            pairs = pair_map_images(
                mapping,
                options,
                retrieval=retrieval,
                tables=read_tables_of(mapping.root),
                covisible=None if covisible is None else self.kapture_map(covisible),
            )
        write_pairs(self.output, pairs)
        self.say(f"{len(pairs)} pairs")


@dataclass(frozen=True, kw_only=True)
class PairsQuery(Reading, Choosing, Working):
    """Choose the map images to match with each query."""

    input: Input
    """Kapture folder of the map."""
    query: Path
    """Kapture folder of the queries."""
    output: Output
    """Pairs file."""
    topk: int | None = None
    """Number of most similar map images per query."""
    features: tuple[str, ...] = ()
    """Types of global features; several types are fused. Required if several exist."""
    fusion: FusionMethod | None = None
    """Fusion of several types; if omitted, the preset's."""
    exhaustive: bool = False
    """Pair each query with all map images; for small maps."""
    rerank: int | None = None
    """Rerank the candidates by local matches and keep this many."""
    rerank_by: Literal["coverage", "verified", "matches"] = "coverage"
    """Score of a candidate. matches: number of matches; verified: number of matches that a two-view
    geometry verifies; coverage: number of verified query keypoints not yet covered by better
    candidates."""
    local_features: tuple[str, ...] = ()
    """Types of local features to rerank by; if omitted, all that both folders have."""
    matches_dir: Path | None = None
    """Folder for the matches computed for reranking."""
    force: Overwrite = False
    """Overwrite the pairs file, and write into a non-empty folder of matches."""

    def run(self) -> None:
        if (self.rerank is None) != (self.matches_dir is None):
            raise OptionError("--rerank N needs --matches-dir DIR for its matches, and vice versa")
        check_new_file(self.output, force=self.force)
        mapping = self.kapture_map(self.input)
        query = self.kapture(self.query)
        mapping.check_features_apart(query)
        by = "exhaustive" if self.exhaustive else "retrieval"
        options = self.options({"query_pairs": _changes(by, self.topk)})
        retrieval = None
        if not self.exhaustive:
            retrieval = _retrieval(mapping, self.features, self.fusion, options)
        with single_threaded():
            pairs = pair_queries(
                mapping,
                query,
                options.query_pairs,
                retrieval=retrieval,
                tables=read_tables_of(self.query),
            )
        if self.rerank is not None and self.matches_dir is not None:
            local_types = self._types_of_both(mapping, query)
            verification = options.verify_queries()
            with self.staged(self.matches_dir, FEATURES, force=self.force, adds=True) as (
                out,
                work,
            ):
                for name in local_types:
                    matcher = options.make_matcher(name)
                    match_pairs(query, mapping, pairs, name, matcher, verification, out, work=work)
                matched = query.with_features([*query.features_dirs, out])
                how = RerankingOptions(by=self.rerank_by, keep=self.rerank)
                pairs = reranked(pairs, matched, out, local_types, how)
        write_pairs(self.output, pairs)
        self.say(f"{len(pairs)} pairs")

    def _types_of_both(self, mapping: KaptureFolder, query: KaptureFolder) -> list[str]:
        both = set(mapping.types("descriptors")) & set(query.types("descriptors"))
        asked = self.local_features or sorted(both)
        check_option(
            asked,
            f"{query.root}: no type of local features in common with the map; give the folder "
            "of the features with --features-dir",
        )
        return [only_type(mapping, "descriptors", name) for name in asked]


def _changes(by: object, topk: int | None) -> dict[str, object]:
    return {"by": by} | ({} if topk is None else {"top_k": topk})


def _retrieval(
    mapping: KaptureFolder,
    asked: Sequence[str],
    fusion: FusionMethod | None,
    options: PipelineOptions,
) -> Retrieval:
    """Return the types of global features to compare, and how to fuse them."""
    types = tuple(only_type(mapping, "global_features", name) for name in asked or (None,))
    how = options.fusion
    if fusion is not None:
        how = how.model_copy(update={"method": fusion})
    return Retrieval(types, fusion=how)


@dataclass(frozen=True, kw_only=True)
class OutsideStage(Working):
    stage: ClassVar[str]

    workspace: Annotated[Path, tyro.conf.arg(aliases=["-w"])]
    """Workspace of megloc eval with the stage's inputs."""
    set: Texts = ()
    """Change an option of the stage: key=value; may be repeated."""

    def run(self) -> None:
        stage = load_plugin(STAGES, self.stage, parse_assignments(self.set))
        check_option(
            (self.workspace / "stages").is_dir(),
            f"{self.workspace} is not a workspace of megloc eval",
        )
        workspace = Workspace(self.workspace)
        with self.working_in(workspace) as work:
            run_plan([stage], workspace, work, say=self.say)


def stage_command(name: str) -> type[Any]:
    """Return the command of a registered stage."""
    text = plugin_class(STAGES, name).__doc__ or f"Run the stage {name}."
    return type(name, (OutsideStage,), {"stage": name, "__doc__": text})


@dataclass(frozen=True, kw_only=True)
class Preprocess(Computing, Working):
    """Resize, undistort and mask the images of a kapture folder; cameras are adapted."""

    allow_links_below: AllowedLinks = ()
    input: Input
    """Kapture folder; not modified."""
    output: Output
    """Kapture folder of the new images."""
    resize: int | None = None
    """Reduce the larger side to this many px, then crop both sides to multiples of 8."""
    undistort: bool = False
    """Remove lens distortion."""
    segmenter: str | None = None
    """Segmenter plugin whose dynamic classes (people, vehicles) are masked."""
    dynamic: tuple[str, ...] = ()
    """Classes to mask; if omitted, the segmenter's dynamic classes."""
    bottom_share: Texts = ()
    """Mask the bottom of images: CAMERA=0.2; CAMERA is a sensor id or a pattern of image names."""
    polygon: Texts = ()
    """Mask a polygon: CAMERA="x,y x,y x,y", corners as fractions of width and height."""
    mask_file: Texts = ()
    """Mask the pixels that are 0 in this image file, which has the camera's size: CAMERA=FILE."""
    unchanging: bool = False
    """Detect and mask the static ego-vehicle region of each camera."""
    sequence: Folders = ()
    """Additional images of the same cameras (kapture folder) for --unchanging; may be repeated."""
    user_masks: Path | None = None
    """Folder of masks IMAGE.png; pixels of value 0 are masked."""
    set: Texts = ()
    """Another option, such as upscale=true; may be repeated."""
    force: Force = False

    def run(self) -> None:
        options = self.options()
        source = kapture_map(self.input)
        sequences = [KaptureFolder(path) for path in self.sequence]
        with self.staged(self.output, PREPROCESSED, force=self.force) as (out, work):
            counts = preprocess_images(source, out, options, sequences=sequences, work=work)
            write_unit(out, unit_of(source.root))
        self.say(f"{counts['images']} images, {counts['images_changed']} of them changed")
        for name, share in counts.items():
            if name.startswith("masked_"):
                source_of_masks = name.removeprefix("masked_")
                self.say(f"masked ({source_of_masks}): {100 * share:.2f} % of all pixels")

    def options(self) -> PreprocessingOptions:
        masks: dict[str, Any] = {
            "segmenter": None if self.segmenter is None else {"name": self.segmenter},
            "dynamic": self.dynamic or None,
            "fixed": tuple(self._fixed_masks()),
            "unchanging": self.unchanging,
            "user_masks": self.user_masks,
        }
        flags = {"max_size_px": self.resize, "undistort": self.undistort, "masks": masks}
        given = parse_assignments(self.set)
        given |= given.pop("preprocessing", {})  # the prefix of these options elsewhere
        return options_with(PreprocessingOptions, given, flags)

    def _fixed_masks(self) -> Iterator[dict[str, Any]]:
        """Yield the mask of each ``CAMERA=VALUE``, split at the last ``=``."""
        for flag, key, texts in (
            ("--bottom-share", "bottom_share", self.bottom_share),
            ("--polygon", "polygon", self.polygon),
            ("--mask-file", "file", self.mask_file),
        ):
            for text in texts:
                camera, _, value = text.rpartition("=")
                check_option(camera and value, f"{flag} takes CAMERA=VALUE, got {text!r}")
                corners = [corner.split(",") for corner in value.split()]
                yield {"camera": camera, key: corners if key == "polygon" else value}
