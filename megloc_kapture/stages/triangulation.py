"""Stage: a kapture map: points3d and observations from verified matches and known poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
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
    images = sorted(data.poses())
    if not images:
        raise DataError("no mapping image has a pose", path=mapping.root)
    asked = None if pairs is None else {tuple(sorted((pair.query, pair.map))) for pair in pairs}
    of_type = {name: _matched_pairs(matches.matches(name), images, asked) for name in types}
    for name in types:
        mapping.keypoints(name)  # refused before any work
    specs = FolderSpec(mapping), FolderSpec(matches)
    xyz, errors_px = np.zeros((0, 3)), np.zeros(0)
    observations = {}
    by_type: dict[str, float] = {}
    for name, matched in of_type.items():
        parts = _unconnected(len(images), matched)
        threads = 1 if len(parts) > 1 and work.executor is not None else num_threads
        part = partial(_triangulate_part, specs, name, options, threads, output.absolute())
        found = _triangulate(part, images, matched, parts, work, f"triangulation of {name}")
        observations[name] = Observations(
            keypoints_type=name,
            image_names=tuple(images),
            point_ids=found.point_ids + len(xyz),
            image_ids=found.image_ids.astype(np.int32),
            keypoint_ids=found.keypoint_ids.astype(np.int32),
        )
        xyz = np.concatenate([xyz, found.xyz])
        errors_px = np.concatenate([errors_px, found.errors_px])
        by_type[f"points_{name}"] = len(found.xyz)
        by_type[f"observations_{name}"] = len(found.point_ids)
    write_sensors(output, data)
    link_images(mapping.root, output)
    # with a pyramid's type the one it begins with: queries are matched with that at first
    there = mapping.types("keypoints")
    copy_features(mapping, output, {*types, *map(base_type, types)}.intersection(there))
    # kapture keeps a colour per point; black says that nobody looked it up
    write_points3d(output, np.concatenate([xyz, np.zeros_like(xyz)], axis=1))
    write_observations(output, observations)
    num_observations = sum(map(len, observations.values()))
    return {
        "images": len(images),
        "pairs": sum(map(len, of_type.values())),
        "points": len(xyz),
        "observations": num_observations,
        **(by_type if len(types) > 1 else {}),
        "mean_track_length": round(num_observations / max(len(xyz), 1), 3),
        "mean_reprojection_error_px": round(float(errors_px.mean()), 4) if len(xyz) else 0.0,
    }


def verified_matches(
    reader: MatchesReader, images: Sequence[str], asked: Collection[tuple[str, ...]] | None = None
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


_Part = tuple[list[str], NDArray[np.int64]]  # images, and pairs (P, 2) of them that match


def _triangulate(
    triangulate_part: Callable[[_Part], TriangulatedPoints],
    images: list[str],
    pairs: NDArray[np.int64],
    members: Sequence[NDArray[np.int64]],
    work: Work,
    label: str,
) -> TriangulatedPoints:
    """Points of the images, part by part where no match connects them."""
    if len(members) == 1:
        return triangulate_part((images, pairs))
    parts = [
        (
            [images[row] for row in rows.tolist()],
            np.searchsorted(rows, pairs[np.isin(pairs[:, 0], rows)]),
        )
        for rows in members
    ]
    found = list(work.map(triangulate_part, parts, label))
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


def _triangulate_part(
    specs: tuple[FolderSpec, FolderSpec],
    local_type: str,
    options: TriangulationOptions,
    num_threads: int,
    scratch: Path,
    part: _Part,
) -> TriangulatedPoints:
    names, pairs = part
    mapping, reader = specs[0].open(), specs[1].open().matches(local_type)
    data, keypoints = mapping.read(), mapping.keypoints(local_type)
    images = [
        MapImage(image, data.camera_of(image), pose, keypoints.read(image)[:, :2])
        for image in names
        if (pose := data.cam_from_world(image)) is not None  # all have one
    ]
    verified = _read(reader, names, pairs)
    return triangulate(images, verified, options, num_threads=num_threads, scratch=scratch)


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


_READ = {
    "keypoints": KaptureFolder.keypoints,
    "descriptors": KaptureFolder.descriptors,
    "global_features": KaptureFolder.global_features,
}
_KINDS: tuple[ArrayKind, ...] = ("keypoints", "descriptors", "global_features")
_VOCABULARY_FILES = ("vlad.json", "vocabulary.npy")


def copy_features(
    source: KaptureFolder,
    output: Path,
    local_types: Iterable[str] | None = None,
    *,
    link_own: bool = False,
) -> None:
    """Put the map images' features of ``source`` into the kapture at ``output``; what is there
    stays.

    Files of features folders are hard links where the file system has them: a map then stands alone
    and takes no space twice. The kapture's own features, which come first as everywhere, are
    somebody's data and copied, unless ``link_own`` says that they are ours; what comes out of a tar
    is copied. ``local_types``: all types of local features unless given; of global features all are
    copied.
    """
    wanted = None if local_types is None else set(local_types)
    for kind in _KINDS:
        for name in source.types(kind):
            if kind == "global_features" or wanted is None or name in wanted:
                _copy_type(source, output, kind, name, link_own=link_own)


def _copy_type(
    source: KaptureFolder, output: Path, kind: ArrayKind, type_name: str, *, link_own: bool
) -> None:
    copies, suffix = output / "reconstruction" / kind / type_name, SUFFIX[kind]
    images, own = source.read().image_names(), source.with_features(())
    kept = set(_READ[kind](own, type_name).names) if type_name in own.types(kind) else set()
    parent = "global_features" if kind == "global_features" else "local_features"
    beside = [source.root / "reconstruction" / kind / type_name]
    for image in sorted(kept) if link_own else ():
        if (file := beside[0] / f"{image}{suffix}").is_file():
            hard_link(file, copies / f"{image}{suffix}")
    for features_dir in source.features_dirs:
        found = features_dir / parent / type_name / kind
        beside.append(found.parent)
        for image in images:
            file, copy = found / f"{image}{suffix}", copies / f"{image}{suffix}"
            if image not in kept and file.is_file() and not copy.exists():  # the first has it
                hard_link(file, copy)
    if kind == "global_features":
        for folder, name in product(beside, _VOCABULARY_FILES):
            if (folder / name).is_file() and not (copies / name).exists():
                hard_link(folder / name, copies / name)
    reader = _READ[kind](source, type_name)
    with FeatureWriter(output, kind, type_name, reader.config) as writer:
        for image in images:
            if image not in writer and image in reader:
                writer.write(image, reader.read(image))
