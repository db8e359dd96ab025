"""Commands of retrieval: global features and image pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from megloc_kapture.cli.common import Console, Folders, Force, Input, Output, Overwrite, Reading
from megloc_kapture.cli.stages import FEATURES, StageCommand, only_type
from megloc_kapture.errors import OptionError, check_option
from megloc_kapture.io.kapture import KaptureFolder, write_pairs
from megloc_kapture.pipeline.kapture_map import restrictions_beside
from megloc_kapture.retrieval.search import FusionMethod
from megloc_kapture.stages.global_features import extract_global_features, extract_vlad, vlad_type
from megloc_kapture.stages.image_pairs import (
    PairingMethod,
    RerankingOptions,
    Retrieval,
    pair_map_images,
    pair_queries,
    reranked,
)
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.options import PipelineOptions


@dataclass(frozen=True, kw_only=True)
class ExtractGlobal(Reading, StageCommand):
    """Compute global features of all images: VLAD trained on the map, or networks."""

    input: Input
    """Kapture folder of the map; VLAD is trained on its descriptors."""
    query: Folders = ()
    """Kapture folder of queries to describe as well; may be repeated."""
    output: Output
    """Features folder: global_features/T/global_features."""
    features: tuple[str, ...] = ()
    """Global features: vlad, or plugins; if omitted, the preset's."""
    local_type: str | None = None
    """Local features that VLAD aggregates; required if several types exist."""
    force: Force = False

    def run(self, console: Console) -> None:
        choices = self.options(self.named("global_features", self.features)).global_features
        folders = [self.kapture_map(self.input), *map(self.kapture, self.query)]
        extractors = {one.name: one.make(self.placement()) for one in choices if not one.is_vlad}
        with self.staged(self.output, FEATURES, force=self.force, adds=True) as (out, work):
            for choice in choices:
                if choice.is_vlad:
                    options = choice.vlad_options()
                    asked = self.local_type or options.local_type
                    local_type = only_type(folders[0], "descriptors", asked)
                    type_name = vlad_type(local_type)
                    counts = extract_vlad(
                        folders[0], folders, local_type, out, options.of_vlad(), work=work
                    )
                else:
                    extractor = extractors[choice.name]
                    type_name = extractor.name
                    counts = extract_global_features(folders, extractor, out, work=work)
                console.say(f"{type_name}: {counts['images']} images")


@dataclass(frozen=True, kw_only=True)
class PairsMapping(Reading, StageCommand):
    """Choose pairs of map images to match."""

    input: Input
    """Kapture folder with poses."""
    output: Output
    """Pairs file."""
    by: tuple[PairingMethod, ...] = ("retrieval",)
    """Method; several are united."""
    topk: int | None = None
    """Number of most similar images per image (retrieval)."""
    covisibility_map: Path | None = None
    """Kapture map of the same images, for the points that they share; if omitted, the input."""
    features: tuple[str, ...] = ()
    """Types of global features, several are fused; required if several exist."""
    fusion: FusionMethod | None = None
    """Fusion of several types; if omitted, the preset's."""
    force: Overwrite = False
    """Overwrite the pairs file."""

    def run(self, console: Console) -> None:
        mapping = self.kapture_map(self.input)
        chosen = self.options({"mapping_pairs": _changes(self.by, self.topk)})
        options = chosen.mapping_pairs
        covisible = self.covisibility_map
        if covisible is not None and not options.needs_points():
            raise OptionError("--covisibility-map is for --by covisibility")
        retrieval = None
        if "retrieval" in self.by:
            retrieval = _retrieval(mapping, self.features, self.fusion, chosen)
        with self.working(self.output):
            pairs = pair_map_images(
                mapping,
                options,
                retrieval=retrieval,
                restrictions=restrictions_beside(mapping.root),
                covisible=None if covisible is None else self.kapture_map(covisible),
            )
        _refuse_existing(self.output, force=self.force)
        write_pairs(self.output, pairs)
        console.say(f"{len(pairs)} pairs")


@dataclass(frozen=True, kw_only=True)
class PairsQuery(Reading, StageCommand):
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
    """Types of global features, several are fused; required if several exist."""
    fusion: FusionMethod | None = None
    """Fusion of several types; if omitted, the preset's."""
    exhaustive: bool = False
    """Pair each query with all map images; for small maps."""
    rerank: int | None = None
    """Rerank the candidates by local matches and keep this many."""
    rerank_by: Literal["coverage", "verified", "matches"] = "coverage"
    """Score of a candidate: its matches, the verified ones (two-view geometry), or coverage (of
    these, at keypoints that better candidates do not match)."""
    local_features: tuple[str, ...] = ()
    """Types of local features to rerank by; if omitted, all types of map and queries."""
    matches_dir: Path | None = None
    """Folder for the matches of reranking, which later steps use."""
    force: Overwrite = False
    """Overwrite the pairs file and the folder of matches."""

    def run(self, console: Console) -> None:
        if (self.rerank is None) != (self.matches_dir is None):
            raise OptionError("--rerank N and --matches-dir DIR go together: matches are kept")
        _refuse_existing(self.output, force=self.force)
        mapping = self.kapture_map(self.input)
        query = self.kapture(self.query)
        mapping.check_features_apart(query)
        by = "exhaustive" if self.exhaustive else "retrieval"
        options = self.options({"query_pairs": _changes(by, self.topk)})
        retrieval = None
        if not self.exhaustive:
            retrieval = _retrieval(mapping, self.features, self.fusion, options)
        with self.working(self.output):
            pairs = pair_queries(
                mapping,
                query,
                options.query_pairs,
                retrieval=retrieval,
                restrictions=restrictions_beside(self.query),
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
        _refuse_existing(self.output, force=self.force)
        write_pairs(self.output, pairs)
        console.say(f"{len(pairs)} pairs")

    def _types_of_both(self, mapping: KaptureFolder, query: KaptureFolder) -> list[str]:
        both = set(mapping.types("descriptors")) & set(query.types("descriptors"))
        asked = self.local_features or sorted(both)
        check_option(
            asked,
            f"{query.root}: no local features that the map has as well; give their folder "
            "with --features-dir",
        )
        return [only_type(mapping, "descriptors", one) for one in asked]


def _changes(by: object, topk: int | None) -> dict[str, object]:
    return {"by": by} | ({} if topk is None else {"top_k": topk})


def _retrieval(
    mapping: KaptureFolder,
    asked: Sequence[str],
    fusion: FusionMethod | None,
    options: PipelineOptions,
) -> Retrieval:
    """Return the global-feature types to compare, with the preset's weights."""
    types = tuple(only_type(mapping, "global_features", one) for one in asked or (None,))
    how = options.fusion
    if fusion is not None:
        how = how.model_copy(update={"method": fusion})
    return Retrieval(types, fusion=how)


def _refuse_existing(path: Path, *, force: bool) -> None:
    check_option(not path.exists() or force, f"{path} exists; -f overwrites it")
