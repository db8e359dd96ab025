"""A 3D view of a map, and of a result in it: one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.evaluation.evaluate import (
    Localized,
    benchmark_beside,
    evaluate_results,
    results_without_truth,
)
from megloc_kapture.evaluation.results import Poses, ResultContext
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera

# a view has this within its first bytes
_OURS, _HEAD_BYTES = b'content="megloc view"', 1000


def write_view(
    path: Path | str,
    mapping: KaptureFolder | Path | str,
    result: Localized | None = None,
    truth: Path | str | Poses | None = None,
    *,
    cameras: Mapping[str, Camera] | None = None,
    force: bool = False,
) -> str:
    """Write a self-contained 3D page of a map and of the queries of a result.

    Another view at ``path`` is overwritten, other files only with ``force``. ``result`` and
    ``truth`` are as in :func:`megloc_kapture.evaluation.evaluate.evaluate`: queries are coloured by
    their error, or by their confidence without truth. Returns sentences on what is left out.
    """
    from megloc_kapture.evaluation.report.queries import StoredInliers, shown_queries
    from megloc_kapture.evaluation.report.scene import render_view, scene_of

    path = Path(path)
    _check_output(path, force=force)
    folder = mapping if isinstance(mapping, KaptureFolder) else KaptureFolder(mapping)
    title = folder.root.resolve().name
    context, queries = ResultContext(mapping=folder), []
    if result is not None:
        evaluation = _evaluate(result, truth, folder)
        context, queries = evaluation.context, shown_queries(evaluation)
        # cameras that were estimated with the poses come first
        context = replace(context, cameras={**(cameras or {}), **context.cameras})
        title = evaluation.label or title
    elif truth is not None:
        raise OptionError("a truth needs a result to be compared with")
    scene = scene_of(title, StoredInliers(context), queries)
    if scene is None:
        raise DataError("no image has a pose, so there is nothing to see", path=folder.root)
    write_bytes(path, render_view(scene).encode("utf-8"))
    return " ".join(scene.notes)


def _evaluate(
    result: Localized, truth: Path | str | Poses | None, folder: KaptureFolder
) -> Evaluation:
    benchmark = benchmark_beside([truth, result])
    labels = [""] if isinstance(result, Mapping) else None
    if truth is None:
        reported = results_without_truth([result], benchmark, mapping=folder.root, labels=labels)
        return reported.evaluations[0]
    return evaluate_results([result], truth, benchmark, mapping=folder.root, labels=labels)[0]


def _check_output(path: Path, *, force: bool) -> None:
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file, such as view.html")
    if force or not path.exists():
        return
    with open(path, "rb") as file:
        is_view = _OURS in file.read(_HEAD_BYTES)
    if not is_view:
        raise OutputError(f"{path}: exists and is no view; -f overwrites it")
