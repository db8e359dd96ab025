"""Challenge pose files of a localized kapture folder, and the folder that collects them."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError, require
from megloc_kapture.evaluation.pose_files import (
    format_mlad_file,
    format_pose_file,
    is_name,
    name_by_rule,
    provenance_path,
    relative_pose,
    timestamp_of,
    write_provenance,
)
from megloc_kapture.io.dataset_tables import (
    NO_TABLES,
    RELOCALIZATION_FILE,
    SideTables,
    read_side_tables,
    read_unreadable,
)
from megloc_kapture.io.files import read_text, safe_join, temporary_name, write_bytes, write_json
from megloc_kapture.io.kapture import KaptureFolder, is_kapture
from megloc_kapture.io.tables import STATUS_FILE, read_status
from megloc_kapture.pipeline.plan import Manifest, read_manifests
from megloc_kapture.stages import scene
from megloc_kapture.stages.paths import MAPPING, QUERY
from megloc_kapture.values import LocalizationResult, Pose, RigidTransform

_log = logging.getLogger(__name__)

_Content = tuple[Mapping[str, str], Sequence[str], Sequence[tuple[str, str]]]
_Results = Mapping[str, LocalizationResult]
"""Results by image, with the submitted poses, including fallbacks."""


def write_submission(
    localized: Path,
    place: Path,
    *,
    tables: Path | None,
    provenance: Mapping[str, Any],
    from_rig: bool = False,
) -> dict[str, int]:
    """Write the pose file or files of a localized kapture folder, and their provenance.

    Poses are written in the official frame. A query without a pose has no row, except for MLAD,
    where its row is an identity pose that counts as missing.

    Parameters
    ----------
    place : the file; for MLAD a folder with one file per relocalization file.
    tables : the workspace's ``megloc/`` folder; without it, all queries are used, in the map frame.
    provenance : entries for the provenance (dataset, preset, options).
    from_rig : derive missing and fallback poses from other cameras of the rig.

    Returns
    -------
    Counts by name: ``queries``; ``scored``, the scored images (MLAD: rows); ``poses`` and
    ``missing``, scored with and without a pose; ``doubtful``, missing because of low confidence;
    ``fallbacks``, poses of the best candidate; ``from_rig``, poses derived from the rig;
    ``dummies``, MLAD rows with an identity pose.
    """
    beside = None if tables is None else tables.parent
    side = NO_TABLES if tables is None else read_side_tables(tables)
    results = _read_results(localized, beside, from_rig=from_rig)
    unreadable = {} if tables is None else read_unreadable(tables)
    is_mlad = side.protocol.pose_file == "mlad"
    if is_mlad and tables is not None:
        texts, posed, missing = _mlad(results, side, tables)
        for name, text in texts.items():
            write_bytes(safe_join(place, name), text.encode("ascii"))
    else:
        texts, posed, missing = _ltvl(results, side, unreadable)
        write_bytes(place, texts[""].encode("utf-8"))
    counts = {
        "queries": len(results) + len(unreadable),
        "scored": len(posed) + len(missing),
        "poses": len(posed),
        "missing": len(missing),
        "doubtful": len({image for _, image in missing if _is_doubtful(results.get(image))}),
        "fallbacks": sum(results[image].fallback == "retrieval" for image in posed),
        "from_rig": sum(results[image].fallback == "rig" for image in posed),
        "dummies": len(missing) if is_mlad else 0,
    }
    known = set(posed)
    imported = None if beside is None else read_manifests(beside).get("import")
    entries = {
        **provenance,
        "weights": _weights(localized),
        "confidence": {
            image: result.confidence
            for image, result in sorted(results.items())
            if image in known and result.status == "localized" and result.confidence is not None
        },
        "dataset_fingerprint": None if imported is None else imported.fingerprint,
        "dummies" if is_mlad else "missing": [row for row, _ in missing],
    }
    write_provenance(place, entries, counts=counts, files=list(texts) if is_mlad else None)
    return counts


def _read_results(localized: Path, beside: Path | None, *, from_rig: bool) -> _Results:
    localized_data = KaptureFolder(localized).read()
    data = localized_data
    query = None if beside is None else beside / QUERY
    if query is not None and is_kapture(query):
        # the imported queries have the rig, and all images; a third-party result may lack images
        data = KaptureFolder(query).read()
        strange = set(localized_data.image_names()) - set(data.image_names())
        if strange:
            raise DataError(
                f"image {min(strange)!r} is not among the queries of {query}: does the result "
                "belong to this dataset?",
                path=localized,
            )
    path, poses = localized / STATUS_FILE, localized_data.poses()
    statuses = read_status(path) if path.is_file() else {}
    results = {
        name: replace(statuses.get(name, LocalizationResult()), cam_from_world=poses.get(name))
        for name in data.image_names()
    }
    if from_rig:
        require(
            data.rigs,
            "poses cannot be derived from the rig: the queries have no rigs.txt",
            path=localized,
        )
        # use the rig camera with the most inliers; fallback poses are replaced, never propagated
        known = {
            image: Pose(pose, num_inliers=results[image].num_inliers or 0)
            for image, pose in poses.items()
            if image not in statuses or statuses[image].status == "localized"
        }
        for image, (_, pose) in scene.poses_through_rig(data, known).items():
            results[image] = replace(results[image], cam_from_world=pose, fallback="rig")
    return results


def _is_doubtful(result: LocalizationResult | None) -> bool:
    return result is not None and result.status == "failed" and result.confidence is not None


def _posed(results: _Results) -> dict[str, RigidTransform]:
    poses = {image: result.cam_from_world for image, result in results.items()}
    return {image: pose for image, pose in poses.items() if pose is not None}


def _ltvl(results: _Results, side: SideTables, unreadable: Collection[str]) -> _Content:
    poses = _posed(results)
    names, rule = side.names, side.protocol.pose_file_names
    images = list(names) or sorted(side.scored({*results, *unreadable}))
    posed = [image for image in images if image in poses]
    unnamed = [] if names else [i for i in posed if not is_name(name_by_rule(i, rule))]
    if unnamed:
        message = "%d images are left out, as names in a pose file cannot contain white space: %s%s"
        more = ", ..." if len(unnamed) > 1 else ""
        _log.warning(message, len(unnamed), repr(unnamed[0]), more)
        posed = sorted(set(posed) - set(unnamed))
    official = {image: side.world.pose_in_official(poses[image]) for image in posed}
    text = format_pose_file(official, names=names or rule)
    with_row = set(posed)
    return {"": text}, posed, [(image, image) for image in images if image not in with_row]


def _mlad(results: _Results, side: SideTables, tables: Path) -> _Content:
    """Return texts by file name, the query of each row with a pose, and the rows without a pose.

    A row without a pose is given by its description and its query.
    """
    require(
        side.relocalization,
        "no pairs, which an MLAD challenge needs: was the dataset imported with its "
        "relocalization files?",
        path=tables / RELOCALIZATION_FILE,
    )
    poses = _posed(results)
    scale = side.world.official_from_local.scale
    references = KaptureFolder(tables.parent / MAPPING).read().poses()
    rows: dict[str, dict[tuple[int, int], RigidTransform]] = {}
    posed, missing = [], []
    for pair in side.relocalization:
        query, reference = poses.get(pair.query), references.get(pair.reference)
        if query is None or reference is None:
            missing.append((f"{pair.file}: {pair.reference} {pair.query}", pair.query))
            pose = RigidTransform.identity()  # as in kapture's exporter
        else:
            posed.append(pair.query)
            pose = relative_pose(query, reference, scale=scale)
        stamps = timestamp_of(pair.reference), timestamp_of(pair.query)
        rows.setdefault(pair.file, {})[stamps] = pose
    return {name: format_mlad_file(image_rows) for name, image_rows in rows.items()}, posed, missing


def workspace_provenance(localized: Path) -> dict[str, Any]:
    """Return a result's fingerprint, preset and options, if its manifests are up to date."""
    made, manifests = _made_by(localized)
    if made is None:
        return {}
    provenance: dict[str, Any] = {"localization_fingerprint": made.fingerprint}
    handed_in = manifests.get("submission")
    if handed_in is not None and handed_in.inputs.get(made.stage) == made.output:
        options = handed_in.options
        provenance |= {key: options[key] for key in ("preset", "options") if key in options}
    return provenance


def _weights(localized: Path) -> dict[str, str]:
    """Return the SHA-256 by file name of all network weights used for a workspace's result."""
    made, manifests = _made_by(localized)
    reached: dict[str, Manifest] = {}
    waiting = [] if made is None else [made]
    while waiting:
        manifest = waiting.pop()
        reached[manifest.stage] = manifest
        for stage, output in manifest.inputs.items():
            before = manifests.get(stage)
            if before is not None and before.output == output and stage not in reached:
                waiting.append(before)
    weights = [step.options.get("weights") for step in reached.values()]
    sha_of = {file: sha for part in weights if isinstance(part, dict) for file, sha in part.items()}
    return dict(sorted(sha_of.items()))


def _made_by(localized: Path) -> tuple[Manifest | None, Mapping[str, Manifest]]:
    """Return the manifest of the stage that wrote a result, and all manifests of its workspace."""
    place = localized.resolve()
    manifests = read_manifests(place.parent)
    made = (manifest for manifest in manifests.values() if place.name in manifest.outputs)
    return next(made, None), manifests


FOLDER = "submissions"


def keep_submission(place: Path, folder: Path) -> Path:
    """Copy a submission and its provenance into a folder of submissions; return the copy's path.

    Identical content is not copied again; a name that is taken gets a number, ``..._METHOD-2.txt``.
    """
    for path in (place, provenance_path(place)):
        require(path.exists(), "no such file; --from submission rewrites it", path=path)
    provenance = json.loads(read_text(provenance_path(place)))
    # folders have no suffix, even with a dot in their name
    suffix = place.suffix if place.is_file() else ""
    for number in count(1):
        numbered = "" if number == 1 else f"-{number}"
        kept = folder / f"{place.name.removesuffix(suffix)}{numbered}{suffix}"
        if kept.exists() and _hashes(kept) == _hashes(place):
            return kept
        if not os.path.lexists(kept) and not os.path.lexists(provenance_path(kept)):
            break
    if place.is_file():  # the provenance contains the file's name
        provenance["files"] = {kept.name: provenance["files"][place.name]}
    copied = folder / temporary_name()
    folder.mkdir(parents=True, exist_ok=True)
    (shutil.copytree if place.is_dir() else shutil.copyfile)(place, copied)
    copied.rename(kept)
    write_json(provenance_path(kept), provenance)
    return kept


def _hashes(place: Path) -> list[str]:
    path = provenance_path(place)
    return sorted(json.loads(read_text(path))["files"].values()) if path.is_file() else []
