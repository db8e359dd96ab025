"""The stages of retrieval: global features, candidates of the queries, and their reranking.

Where candidates are reranked, all of them are matched, and those that stay are localized with: the
matches are the same, so nothing is matched twice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from megloc_kapture.io.kapture_store import read_pairs, write_pairs
from megloc_kapture.pipeline.global_choice import GlobalFeaturesChoice
from megloc_kapture.pipeline.map_plan import map_images, matched_images, matching_used
from megloc_kapture.pipeline.plan import Stage
from megloc_kapture.pipeline.run import QUERY_CANDIDATES, QUERY_MATCHES, QUERY_PAIRS, Run
from megloc_kapture.plugins import weights_of
from megloc_kapture.stages.global_features import extract_global_features
from megloc_kapture.stages.global_vlad import extract_vlad
from megloc_kapture.stages.image_pairs import pair_queries
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.reranking import reranked


def plan_global_features(run: Run, dump: Mapping[str, Any]) -> Stage:
    """The stage that describes every image.

    Parameters
    ----------
    dump : the options as plain JSON values.
    """
    choices = run.options.global_features
    used: dict[str, Any] = {
        "global_features": [
            {
                "name": chosen.name,
                "options": dict(chosen.options),
                "weights": {} if chosen.is_vlad else weights_of(chosen.make()),
            }
            for chosen in choices
        ]
    }
    after = [run.images_stage]
    if any(chosen.is_vlad for chosen in choices):
        used["local_type"] = run.options.main_type()
        after.append("local_features")
    return Stage(
        "global_features",
        2,
        used,
        tuple(after),
        ("global_features",),
        lambda out: _global_features(run, out),
    )


def plan_query_pairs(run: Run, dump: Mapping[str, Any]) -> list[Stage]:
    """The stages that choose the map images each query is localized with, and match them."""
    options = run.options
    reranks = options.reranking.reranks()
    candidates, first = (
        (QUERY_CANDIDATES, "query_candidates") if reranks else (QUERY_PAIRS, "query_pairs")
    )
    stages = [
        Stage(
            first,
            3,
            {
                "query_pairs": dump["query_pairs"],
                "fusion": dump["fusion"],
                "weights": [chosen.weight for chosen in options.global_features],
            },
            ("import", run.images_stage, "global_features"),
            (candidates,),
            lambda out: _query_pairs(run, out, candidates),
        ),
        Stage(
            "query_matches",
            3,
            {
                "local_types": options.local_types(),
                "matching": matching_used(run, options.local_types()),
                "verification": dump["verification"],
                "two_view": dump["query_verification"],
            },
            (
                run.images_stage,
                "local_features",
                first,
                *(["map"] if options.uses_given_map() else []),
            ),
            (QUERY_MATCHES,),
            lambda out: _query_matches(run, out, candidates),
        ),
    ]
    if reranks:
        stages.append(
            Stage(
                "query_pairs",
                3,
                {"reranking": dump["reranking"]},
                (first, "query_matches"),
                (QUERY_PAIRS,),
                lambda out: _rerank(run, out),
            )
        )
    return stages


def _global_features(run: Run, out: Path) -> dict[str, int]:
    counts: dict[str, int] = {}
    for chosen in run.options.global_features:
        counts[chosen.name] = _describe(run, chosen, out)
    return counts


def _describe(run: Run, chosen: GlobalFeaturesChoice, out: Path) -> int:
    query = run.workspace.folder(run.query, "")
    if not chosen.is_vlad:
        folders = [run.workspace.folder(run.mapping), query]
        found = extract_global_features(folders, chosen.make(), out, work=run.work)
        return found["images"]
    options = chosen.vlad_options()
    local_type = options.local_type or run.options.main_type()
    mapping = map_images(run, local_type)
    found = extract_vlad(
        mapping,
        [mapping, query],
        local_type,
        out,
        options.of_vlad(),
        work=run.work,
    )
    return found["images"]


def _query_pairs(run: Run, out: Path, place: str) -> dict[str, int]:
    pairs = pair_queries(
        map_images(run, run.options.main_type()),
        run.workspace.folder(run.query, ""),
        run.options.query_pairs,
        retrieval=run.options.retrieval(),
        restrictions=run.restrictions(),
    )
    write_pairs(out / place, pairs)
    return {"pairs": len(pairs)}


def _query_matches(run: Run, out: Path, candidates: str) -> dict[str, int]:
    counts: Counter[str] = Counter()
    pairs = read_pairs(run.workspace.path(candidates))
    for local_type in run.options.local_types():
        mapping = matched_images(run, local_type)
        described = mapping.descriptors(local_type)
        found = match_pairs(
            run.workspace.folder(run.query, ""),
            mapping,
            [pair for pair in pairs if pair.map in described],
            local_type,
            run.options.make_matcher(local_type),
            run.options.verify_queries(),
            out / QUERY_MATCHES,
            work=run.work,
        )
        counts.update(found)
    return counts


def _rerank(run: Run, out: Path) -> dict[str, int]:
    pairs = reranked(
        read_pairs(run.workspace.path(QUERY_CANDIDATES)),
        run.workspace.folder(run.query, "", QUERY_MATCHES),
        run.workspace.path(QUERY_MATCHES),
        run.options.local_types(),
        run.options.reranking,
    )
    write_pairs(out / QUERY_PAIRS, pairs)
    return {"pairs": len(pairs), "with_correspondences": sum(pair.score >= 1 for pair in pairs)}
