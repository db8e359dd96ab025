"""Stage: a kapture map: points3d and observations from verified matches and known poses."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import MapImage, TriangulatedPoints, TriangulationOptions, triangulate
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
from megloc_kapture.stages.work import HERE, FolderSpec, Work

_IMAGES_AT_ONCE = 1000  # that parts are put together to


def triangulate_map(
    mapping: KaptureFolder,
    matches: KaptureFolder,
    local_types: Sequence[str] | str,
    output: Path,
    options: TriangulationOptions,
    *,
    pairs: Sequence[ImagePair] | None = None,
    num_threads: int = 1,
    work: Work = HERE,
) -> dict[str, float]:
    """Triangulate and write the map: sensors, features of its types, points3d, observations.

    Each type has points and observations of its own, those of the first type come first. Poses,
    given per camera or per rig, and intrinsics stay exactly what they are. Parts of a large map
    that no match connects are triangulated one by one, which loses nothing: a point is seen from
    one part alone, and poses are known.

    Parameters
    ----------
    mapping : images with poses, and their keypoints.
    matches : where the verified matches of the types are.
    local_types : keypoints types; a repeated one counts once.
    pairs : use the matches of these pairs only.
    num_threads : of COLMAP, where no workers share the parts.

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
    of_type = {name: _matched_pairs(matches.matches(name), images, asked) for name in types}
    for name in types:
        mapping.keypoints(name)  # refused before any work
    specs = FolderSpec(mapping), FolderSpec(matches)
    for type_name, matched in of_type.items():
        part = _Part(*specs, type_name, tuple(images), matched, options, num_threads, output)
        found = _triangulate(part, work)
        observations[type_name] = Observations(
            keypoints_type=type_name,
            image_names=tuple(images),
            point_ids=found.point_ids + sum(map(len, points)),
            image_ids=found.image_ids.astype(np.int32),
            keypoint_ids=found.keypoint_ids.astype(np.int32),
        )
        num_pairs += len(matched)
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
    return _read(reader, images, _matched_pairs(reader, images, asked))


def _read(
    reader: MatchesReader, images: Sequence[str], pairs: NDArray[np.int64]
) -> dict[tuple[int, int], NDArray[np.int64]]:
    return {(a, b): reader.read(images[a], images[b])[0] for a, b in pairs.tolist()}


def _matched_pairs(
    reader: MatchesReader, images: Sequence[str], asked: Collection[tuple[str, ...]] | None
) -> NDArray[np.int64]:
    """Pairs (P, 2) of rows of ``images`` that have a match."""
    row_of = {image: row for row, image in enumerate(images)}
    pairs = [
        (row_of[a], row_of[b])
        for a, b in reader.pairs
        if a in row_of and b in row_of and (asked is None or (a, b) in asked)
        if reader.length(a, b)
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class _Part:
    """Images of a map, and those pairs (P, 2) of them that match."""

    mapping: FolderSpec
    matches: FolderSpec
    local_type: str
    images: tuple[str, ...]
    pairs: NDArray[np.int64]
    options: TriangulationOptions
    num_threads: int
    scratch: Path


def _triangulate(whole: _Part, work: Work) -> TriangulatedPoints:
    """Points of the images, part by part where no match connects them."""
    members = _unconnected(len(whole.images), whole.pairs)
    if len(members) == 1:
        return _triangulate_part(whole)
    parts = [
        replace(
            whole,
            images=tuple(whole.images[row] for row in rows.tolist()),
            pairs=np.searchsorted(rows, whole.pairs[np.isin(whole.pairs[:, 0], rows)]),
            num_threads=whole.num_threads if work.executor is None else 1,
            scratch=whole.scratch.absolute(),
        )
        for rows in members
    ]
    found = list(work.map(_triangulate_part, parts, f"triangulation of {whole.local_type}"))
    before = np.cumsum([0, *(len(one.xyz) for one in found)]).tolist()
    return TriangulatedPoints(
        xyz=np.concatenate([one.xyz for one in found]),
        errors_px=np.concatenate([one.errors_px for one in found]),
        point_ids=np.concatenate(
            [one.point_ids + offset for one, offset in zip(found, before, strict=False)]
        ),
        image_ids=np.concatenate(
            [rows[one.image_ids] for one, rows in zip(found, members, strict=True)]
        ),
        keypoint_ids=np.concatenate([one.keypoint_ids for one in found]),
    )


def _triangulate_part(part: _Part) -> TriangulatedPoints:
    mapping, reader = part.mapping.open(), part.matches.open().matches(part.local_type)
    data, keypoints = mapping.read(), mapping.keypoints(part.local_type)
    images = [
        MapImage(image, data.camera_of(image), pose, keypoints.read(image)[:, :2])
        for image in part.images
        if (pose := data.cam_from_world(image)) is not None  # all have one
    ]
    verified = _read(reader, part.images, part.pairs)
    threads, scratch = part.num_threads, part.scratch
    return triangulate(images, verified, part.options, num_threads=threads, scratch=scratch)


def _unconnected(num_images: int, pairs: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows of the images of parts that no pair connects; small ones are put together."""
    links = csr_array((np.ones(len(pairs)), pairs.T), shape=(num_images, num_images))
    _, part_of = connected_components(links, directed=False)
    rows = np.argsort(part_of, kind="stable")
    groups: list[list[NDArray[np.int64]]] = [[]]
    size = 0
    for part in np.split(rows, np.flatnonzero(np.diff(part_of[rows])) + 1):
        if size and size + len(part) > _IMAGES_AT_ONCE:
            groups.append([])
            size = 0
        groups[-1].append(part)
        size += len(part)
    return [np.sort(np.concatenate(group)) for group in groups]


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
