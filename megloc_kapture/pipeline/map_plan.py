"""The stages that make the map: its points from images, from depth, or as the dataset gives them.

``map_unrefined/`` is what triangulation, lifting or the dataset's own model gives, ``map/`` is that
without the points that refinement rejects; the stage that writes it is always the last.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import KaptureFolder, read_pairs, write_pairs
from megloc_kapture.pipeline.plan import Stage
from megloc_kapture.pipeline.run import (
    MAP,
    MAPPING_MATCHES,
    MAPPING_PAIRS,
    MAPPING_PYRAMID,
    REFERENCE,
    UNREFINED,
    Run,
)
from megloc_kapture.plugins import weights_of
from megloc_kapture.stages.given_map import given_map, given_type, has_descriptors, join_maps
from megloc_kapture.stages.guided_pyramid import pyramid_mapping
from megloc_kapture.stages.image_pairs import pair_map_images
from megloc_kapture.stages.lifting import lift_map
from megloc_kapture.stages.map_refinement import refine_map
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.triangulation import triangulate_map

_OWN, _GIVEN = "map_own", "map_given"


def plan_map(run: Run, dump: Mapping[str, Any]) -> list[Stage]:
    """How the map gets its points; the last stage is called ``map``.

    Parameters
    ----------
    dump : the options as plain JSON values.
    """
    by = run.options.map
    stages: list[Stage] = []
    if run.options.triangulates():
        stages += _matching_stages(run, dump)
    after = ["import", run.images_stage, "local_features", "global_features"]
    options: dict[str, Any] = {"by": by}
    write: Callable[[Run, Path], Mapping[str, float]] = _triangulate
    if by == "lift":
        write, options["lifting"] = _lift, dump["lifting"]
    elif by == "given":
        write = _given
    else:
        after.append("mapping_matches")
        if run.options.matches_again():
            after.append("mapping_pyramid")
        options["triangulation"] = dump["triangulation"]
    stages.append(Stage("points", 1, options, tuple(after), (UNREFINED,), partial(write, run)))
    stages.append(
        Stage(
            "map",
            2,
            {"refinement": dump["refinement"]},
            ("points",),
            (MAP,),
            lambda out: refine_map(
                run.workspace.folder(UNREFINED),
                out / MAP,
                run.options.refinement,
                link_features=True,
                work=run.work,
            ),
        )
    )
    return stages


def check_given(run: Run) -> None:
    """Check the given map, once it is imported.

    Raises
    ------
    DataError : none was imported, or it is not of the type that ``given_features`` extracts.
    """
    found = given_type(run.workspace.folder(REFERENCE))
    expected = run.options.make_given_extractor().name
    if found != expected:
        raise DataError(
            f"the given map is of keypoints type {found!r}, given_features extracts {expected!r}",
            path=run.workspace.path(REFERENCE),
        )


def map_images(run: Run, local_type: str) -> KaptureFolder:
    """The map's images with their features of a type, before there is a map."""
    # descriptors of its own: those that were extracted for it lie in the workspace
    if _is_given(run, local_type) and has_descriptors(run.workspace.folder(REFERENCE)):
        return run.workspace.folder(REFERENCE, "")
    return run.workspace.folder(run.mapping, "")


def matched_images(run: Run, local_type: str) -> KaptureFolder:
    """The map's images with the features of a type that queries are matched with.

    A given map has keypoints of its own, which are not all that its images' extraction gives.
    """
    return (
        run.workspace.folder(MAP)
        if _is_given(run, local_type)
        else run.workspace.folder(run.mapping, *run.mapping_features())
    )


def _is_given(run: Run, local_type: str) -> bool:
    options = run.options
    return options.uses_given_map() and local_type == options.make_given_extractor().name


def _matching_stages(run: Run, dump: Mapping[str, Any]) -> list[Stage]:
    return [
        Stage(
            "mapping_pairs",
            4,
            {
                "mapping_pairs": dump["mapping_pairs"],
                "fusion": dump["fusion"],
                "weights": [chosen.weight for chosen in run.options.global_features],
            },
            (run.images_stage, "global_features"),
            (MAPPING_PAIRS,),
            lambda out: _mapping_pairs(run, out),
        ),
        Stage(
            "mapping_matches",
            2,
            {
                "matching": matching_used(run, run.options.own_types()),
                "verification": dump["verification"],
                "known_poses": dump["mapping_verification"],
            },
            (run.images_stage, "local_features", "mapping_pairs"),
            (MAPPING_MATCHES,),
            lambda out: _mapping_matches(run, out),
        ),
        *(_pyramid_stages(run, dump) if run.options.matches_again() else ()),
    ]


def _pyramid_stages(run: Run, dump: Mapping[str, Any]) -> list[Stage]:
    return [
        Stage(
            "mapping_pyramid",
            1,
            {"guided_pyramid": dump["guided_pyramid"]},
            (run.images_stage, "local_features", "mapping_pairs", "mapping_matches"),
            (MAPPING_PYRAMID,),
            lambda out: _mapping_pyramid(run, out),
        )
    ]


def _mapping_pyramid(run: Run, out: Path) -> dict[str, float]:
    counts: dict[str, float] = {}
    for extractor in run.options.make_extractors():
        found = pyramid_mapping(
            run.workspace.folder(run.mapping, "", MAPPING_MATCHES),
            read_pairs(run.workspace.path(MAPPING_PAIRS)),
            extractor.name,
            extractor,
            run.options.make_matcher(extractor.name),
            run.options.mapping_verification,
            run.options.guided_pyramid,
            out / MAPPING_PYRAMID,
            mask_margin_px=run.options.mask_margin_px,
            work=run.work,
        )
        counts |= {f"{extractor.name} {name}": count for name, count in found.items()}
    return counts


def _mapping_pairs(run: Run, out: Path) -> dict[str, int]:
    options = run.options.mapping_pairs
    pairs = pair_map_images(
        run.workspace.folder(run.mapping, ""),
        options,
        retrieval=run.options.retrieval(),
        restrictions=run.restrictions(),
        covisible=run.workspace.folder(REFERENCE) if run.options.pairs_by_points() else None,
    )
    write_pairs(out / MAPPING_PAIRS, pairs)
    return {"pairs": len(pairs)}


def matching_used(run: Run, local_types: Sequence[str]) -> dict[str, Any]:
    """How each type is matched: part of what a stage's matches depend on."""
    return {
        local_type: {
            **run.options.matching_of(local_type).model_dump(mode="json"),
            "weights": weights_of(run.options.make_matcher(local_type)),
        }
        for local_type in local_types
    }


def _mapping_matches(run: Run, out: Path) -> dict[str, int]:
    mapping = run.workspace.folder(run.mapping, "")
    pairs = read_pairs(run.workspace.path(MAPPING_PAIRS))
    counts: Counter[str] = Counter()
    for local_type in run.options.own_types():
        found = match_pairs(
            mapping,
            mapping,
            pairs,
            local_type,
            run.options.make_matcher(local_type),
            run.options.verify_mapping(),
            out / MAPPING_MATCHES,
            work=run.work,
        )
        counts.update(found)
    return counts


def _lift(run: Run, out: Path) -> dict[str, float]:
    return lift_map(
        run.workspace.folder(run.mapping, ""),
        run.options.own_types(),
        out / UNREFINED,
        run.options.lifting,
        work=run.work,
    )


def _given(run: Run, out: Path, name: str = UNREFINED) -> dict[str, float]:
    check_given(run)
    mapping = run.workspace.folder(run.mapping, "")
    return given_map(run.workspace.folder(REFERENCE), mapping, out / name)


def _triangulate(run: Run, out: Path) -> dict[str, float]:
    joined = run.options.uses_given_map()
    own = out / (_OWN if joined else UNREFINED)
    counts = triangulate_map(
        run.workspace.folder(run.mapping, *run.mapping_features()),
        run.workspace.folder(run.mapping, *run.mapping_features()),
        run.options.point_types(),
        own,
        run.options.triangulation,
        num_threads=run.work.num_threads,
    )
    if not joined:
        return counts
    _given(run, out, _GIVEN)
    both = join_maps(KaptureFolder(own), KaptureFolder(out / _GIVEN), out / UNREFINED)
    return {**both, "points_triangulated": counts["points"]}
