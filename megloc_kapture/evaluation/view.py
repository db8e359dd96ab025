"""A 3D view of a map, and of a result in it: one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.evaluation.evaluate import (
    Localized,
    benchmark_beside,
    evaluate_results,
    results_without_truth,
)
from megloc_kapture.evaluation.results import Poses, ResultContext
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.without_truth import ResultWithoutTruth
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera

if TYPE_CHECKING:
    pass

# what a view has near its beginning
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
    """Write a page that shows a map in 3D, and the queries of a result in it.

    The page holds everything itself and needs no network. Click or tap a query to fly to it.

    Parameters
    ----------
    path : of the file; another view is overwritten, anything else only with ``force``.
    mapping : kapture folder with points, or with the poses of images alone.
    result, truth : as in :func:`megloc_kapture.evaluation.evaluate.evaluate`; queries are coloured
        by their error where the truth is known, else by their confidence.
    cameras : of the queries of a result in memory, where they are known.

    Returns
    -------
    What is left out of the page, in words; empty where nothing is.
    """
    from megloc_kapture.evaluation.report.queries import StoredInliers, shown_queries
    from megloc_kapture.evaluation.report.scene import render_view, scene_of

    path = Path(path)
    _check_output(path, force=force)
    folder = mapping if isinstance(mapping, KaptureFolder) else KaptureFolder(mapping)
    title = folder.root.resolve().name
    context, queries = ResultContext(mapping=folder), []
    if result is not None:
        found = _judged(result, truth, folder)
        context, queries = found.context, shown_queries(found)
        # those that were estimated with the poses come first
        context = replace(context, cameras={**(cameras or {}), **context.cameras})
        title = found.label or title
    elif truth is not None:
        raise OptionError("a truth needs a result to be compared with")
    scene = scene_of(title, StoredInliers(context), queries)
    if scene is None:
        raise DataError("no image has a pose, so there is nothing to see", path=folder.root)
    write_bytes(path, render_view(scene).encode("utf-8"))
    return " ".join(scene.notes)


def _judged(
    result: Localized, truth: Path | str | Poses | None, folder: KaptureFolder
) -> Evaluation | ResultWithoutTruth:
    benchmark = benchmark_beside([truth, result])
    labels = [""] if isinstance(result, Mapping) else None
    if truth is None:
        judged = results_without_truth([result], benchmark, mapping=folder.root, labels=labels)
        return judged.results[0]
    return evaluate_results([result], truth, benchmark, mapping=folder.root, labels=labels)[0]


def _check_output(path: Path, *, force: bool) -> None:
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file, such as view.html")
    if force or not path.exists():
        return
    try:
        with open(path, "rb") as file:
            ours = _OURS in file.read(_HEAD_BYTES)
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    if not ours:
        raise OutputError(f"{path}: exists and is no view; -f overwrites it")
