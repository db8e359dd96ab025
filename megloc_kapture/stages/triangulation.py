"""Stage: a kapture map: points3d and observations from verified matches and known poses."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import output_error
from megloc_kapture.io.colmap import MapImage, TriangulationOptions, triangulate
from megloc_kapture.io.kapture_features import SUFFIX, ArrayKind
from megloc_kapture.io.kapture_store import (
    FeatureReader,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.links import link_images


def triangulate_map(
    mapping: KaptureFolder,
    matches: KaptureFolder,
    local_type: str,
    output: Path,
    options: TriangulationOptions,
    *,
    pairs: Sequence[ImagePair] | None = None,
    num_threads: int = 1,
) -> dict[str, float]:
    """Triangulate and write the map: sensors, features of its type, points3d, observations.

    Parameters
    ----------
    mapping : images with poses, and their keypoints.
    matches : where the verified matches of the type are.
    pairs : use the matches of these pairs only.

    Returns
    -------
    Counts for the log.

    Raises
    ------
    DataError : no image has a pose.
    """
    data = mapping.read()
    poses = data.poses()
    images = sorted(poses)
    if not images:
        raise DataError("no mapping image has a pose", path=mapping.root)
    row_of = {image: row for row, image in enumerate(images)}
    keypoints = mapping.keypoints(local_type)
    reader = matches.matches(local_type)
    verified = {}
    wanted = reader.pairs
    if pairs is not None:
        asked = {tuple(sorted((pair.query, pair.map))) for pair in pairs}
        wanted = [pair for pair in wanted if pair in asked]
    for a, b in wanted:
        if a in row_of and b in row_of:
            indices, _ = reader.read(a, b)
            if len(indices):
                verified[row_of[a], row_of[b]] = indices
    map_images = [
        MapImage(image, data.camera_of(image), poses[image], keypoints.read(image)[:, :2])
        for image in images
    ]
    result = triangulate(map_images, verified, options, num_threads=num_threads)
    write_sensors(output, data)
    link_images(mapping.root, output)
    copy_features(mapping, output, local_type)
    # kapture keeps a colour per point; black says that nobody looked it up
    write_points3d(output, np.concatenate([result.xyz, np.zeros_like(result.xyz)], axis=1))
    write_observations(
        output,
        {
            local_type: Observations(
                keypoints_type=local_type,
                image_names=tuple(images),
                point_ids=result.point_ids,
                image_ids=result.image_ids.astype(np.int32),
                keypoint_ids=result.keypoint_ids.astype(np.int32),
            )
        },
    )
    num_points = len(result.xyz)
    return {
        "images": len(images),
        "pairs": len(verified),
        "points": num_points,
        "observations": len(result.point_ids),
        "mean_track_length": round(len(result.point_ids) / max(num_points, 1), 3),
        "mean_reprojection_error_px": (
            round(float(result.errors_px.mean()), 4) if num_points else 0.0
        ),
    }


_COPIED: tuple[ArrayKind, ...] = ("keypoints", "descriptors", "global_features")
_VOCABULARY_FILES = ("vlad.json", "vocabulary.npy")


def copy_features(source: KaptureFolder, output: Path, local_type: str) -> None:
    """Put the map images' features of ``source`` into the kapture at ``output``.

    Files of features folders are hard links where the file system has them: a map then stands
    alone and takes no space twice. The kapture's own features, which come first as everywhere, are
    somebody's data and copied; so is what comes out of a tar.
    """
    own = KaptureFolder(source.root)
    for kind in _COPIED:
        types = source.types(kind) if kind == "global_features" else [local_type]
        for type_name in types:
            if type_name in source.types(kind):
                _copy_type(source, own, output, kind, type_name)


def _copy_type(
    source: KaptureFolder, own: KaptureFolder, output: Path, kind: ArrayKind, type_name: str
) -> None:
    place = output / "reconstruction" / kind / type_name
    images = source.read().image_names()
    kept = set(_reader(own, kind, type_name).names) if type_name in own.types(kind) else set()
    parent = "global_features" if kind == "global_features" else "local_features"
    beside = [source.root / "reconstruction" / kind / type_name]
    for features_dir in source.features_dirs:
        found = features_dir / parent / type_name / kind
        beside.append(found.parent)
        for image in images:
            file = found / f"{image}{SUFFIX[kind]}"
            if image not in kept and file.is_file():
                _link(file, place / f"{image}{SUFFIX[kind]}")
    if kind == "global_features":
        for folder, name in product(beside, _VOCABULARY_FILES):
            if (folder / name).is_file():
                _link(folder / name, place / name)
    reader = _reader(source, kind, type_name)
    with FeatureWriter(output, kind, type_name, reader.config) as writer:
        for image in images:
            if image not in writer and image in reader:
                writer.write(image, reader.read(image))


def _reader(folder: KaptureFolder, kind: ArrayKind, type_name: str) -> FeatureReader:
    if kind == "keypoints":
        return folder.keypoints(type_name)
    return (
        folder.descriptors(type_name)
        if kind == "descriptors"
        else folder.global_features(type_name)
    )


def _link(source: Path, place: Path) -> None:
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.exists():
            return
        try:
            os.link(source, place)
        except OSError:  # another file system, or one without hard links
            shutil.copyfile(source, place)
    except OSError as error:
        raise output_error(place, error) from error
