"""Stage: a kapture map: points3d and observations from verified matches and known poses."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import MapImage, TriangulationOptions, triangulate
from megloc_kapture.io.files import hard_link, link_images
from megloc_kapture.io.kapture import (
    FeatureReader,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.features import SUFFIX, ArrayKind
from megloc_kapture.io.kapture.matches import MatchesReader
from megloc_kapture.matching.guided_pyramid import base_type


def triangulate_map(
    mapping: KaptureFolder,
    matches: KaptureFolder,
    local_types: Sequence[str] | str,
    output: Path,
    options: TriangulationOptions,
    *,
    pairs: Sequence[ImagePair] | None = None,
    num_threads: int = 1,
) -> dict[str, float]:
    """Triangulate and write the map: sensors, features of its types, points3d, observations.

    Each type has points and observations of its own, those of the first type come first. Poses,
    given per camera or per rig, and intrinsics stay exactly what they are.

    Parameters
    ----------
    mapping : images with poses, and their keypoints.
    matches : where the verified matches of the types are.
    local_types : keypoints types; a repeated one counts once.
    pairs : use the matches of these pairs only.

    Returns
    -------
    Counts for the log; of several types also ``points_T`` and ``observations_T`` for each.

    Raises
    ------
    DataError : no image has a pose, or a type is not there.
    """
    types = tuple(dict.fromkeys([local_types] if isinstance(local_types, str) else local_types))
    data = mapping.read()
    poses = data.poses()
    images = sorted(poses)
    if not images:
        raise DataError("no mapping image has a pose", path=mapping.root)
    asked = None if pairs is None else {tuple(sorted((pair.query, pair.map))) for pair in pairs}
    num_pairs = 0
    points = [np.zeros((0, 3))]
    errors_px = [np.zeros(0)]
    observations = {}
    by_type: dict[str, float] = {}
    of_type = {name: (matches.matches(name), mapping.keypoints(name)) for name in types}
    for type_name, (reader, keypoints) in of_type.items():
        verified = verified_matches(reader, images, asked)
        map_images = [
            MapImage(image, data.camera_of(image), poses[image], keypoints.read(image)[:, :2])
            for image in images
        ]
        found = triangulate(map_images, verified, options, num_threads=num_threads, scratch=output)
        observations[type_name] = Observations(
            keypoints_type=type_name,
            image_names=tuple(images),
            point_ids=found.point_ids + sum(map(len, points)),
            image_ids=found.image_ids.astype(np.int32),
            keypoint_ids=found.keypoint_ids.astype(np.int32),
        )
        num_pairs += len(verified)
        points.append(found.xyz)
        errors_px.append(found.errors_px)
        by_type[f"points_{type_name}"] = len(found.xyz)
        by_type[f"observations_{type_name}"] = len(found.point_ids)
    write_sensors(output, data)
    link_images(mapping.root, output)
    # with a pyramid's type the one it begins with: queries are matched with that at first
    for type_name in {*types, *map(base_type, types)}.intersection(mapping.types("keypoints")):
        copy_features(mapping, output, type_name)
    xyz, errors = np.concatenate(points), np.concatenate(errors_px)
    # kapture keeps a colour per point; black says that nobody looked it up
    write_points3d(output, np.concatenate([xyz, np.zeros_like(xyz)], axis=1))
    write_observations(output, observations)
    num_observations = sum(map(len, observations.values()))
    return {
        "images": len(images),
        "pairs": num_pairs,
        "points": len(xyz),
        "observations": num_observations,
        **(by_type if len(types) > 1 else {}),
        "mean_track_length": round(num_observations / max(len(xyz), 1), 3),
        "mean_reprojection_error_px": round(float(errors.mean()), 4) if len(xyz) else 0.0,
    }


def verified_matches(
    reader: MatchesReader,
    images: Sequence[str],
    asked: Collection[tuple[str, ...]] | None = None,
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Matches by pairs of rows of ``images``; of the pairs asked for alone (first name first)."""
    row_of = {image: row for row, image in enumerate(images)}
    verified = {}
    for a, b in reader.pairs:
        if a in row_of and b in row_of and (asked is None or (a, b) in asked):
            indices, _ = reader.read(a, b)
            if len(indices):
                verified[row_of[a], row_of[b]] = indices
    return verified


_COPIED: tuple[ArrayKind, ...] = ("keypoints", "descriptors", "global_features")
_VOCABULARY_FILES = ("vlad.json", "vocabulary.npy")


def copy_features(
    source: KaptureFolder, output: Path, local_type: str, *, link_own: bool = False
) -> None:
    """Put the map images' features of ``source`` into the kapture at ``output``.

    Files of features folders are hard links where the file system has them: a map then stands
    alone and takes no space twice. The kapture's own features, which come first as everywhere, are
    somebody's data and copied, unless ``link_own`` says that they are ours; what comes out of a
    tar is copied.
    """
    own = source.with_features(())
    for kind in _COPIED:
        types = source.types(kind) if kind == "global_features" else [local_type]
        for type_name in types:
            if type_name in source.types(kind):
                _copy_type(source, own, output, kind, type_name, link_own=link_own)


def _copy_type(
    source: KaptureFolder,
    own: KaptureFolder,
    output: Path,
    kind: ArrayKind,
    type_name: str,
    *,
    link_own: bool,
) -> None:
    place = output / "reconstruction" / kind / type_name
    images = source.read().image_names()
    kept = set(_reader(own, kind, type_name).names) if type_name in own.types(kind) else set()
    parent = "global_features" if kind == "global_features" else "local_features"
    beside = [source.root / "reconstruction" / kind / type_name]
    for image in sorted(kept) if link_own else ():
        file = beside[0] / f"{image}{SUFFIX[kind]}"
        if file.is_file():
            hard_link(file, place / f"{image}{SUFFIX[kind]}")
    for features_dir in source.features_dirs:
        found = features_dir / parent / type_name / kind
        beside.append(found.parent)
        for image in images:
            file, copy = (folder / f"{image}{SUFFIX[kind]}" for folder in (found, place))
            if image not in kept and file.is_file() and not copy.exists():  # the first has it
                hard_link(file, copy)
    if kind == "global_features":
        for folder, name in product(beside, _VOCABULARY_FILES):
            if (folder / name).is_file() and not (place / name).exists():
                hard_link(folder / name, place / name)
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
