"""Features of map images: of the map a dataset comes with, and as maps take them over.

A published model names the keypoints that see its points; to match queries with them they need
descriptors. Where these are published (a COLMAP database) they are taken as they are. Where not,
the images' features are extracted again, and the observations move to those at the same places.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import hard_link, link_images
from megloc_kapture.io.kapture import (
    FeatureWriter,
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.features import SUFFIX, ArrayKind
from megloc_kapture.stages.stage import FEATURES, MAP, REFERENCE, PipelineStage, StageWork

# other implementations of a detector differ by some tenths of a pixel; by chance few are so near
_MAX_SHIFT_PX = 1.0
_MIN_FOUND_AGAIN = 0.5
# a keypoint that is found again is found at the same place but for rounding
_SAME_PLACE_PX = 0.1


def given_type(reference: KaptureFolder) -> str:
    """The keypoints type of a given map."""
    if not reference.has_points():
        raise DataError(
            "no given map: reconstruction/points3d.txt or observations.txt is missing "
            "(import_options.reference_model=true imports a dataset's own)",
            path=reference.root,
        )
    types = sorted(name for name, seen in reference.observations().items() if len(seen))
    if len(types) != 1:
        raise DataError(
            f"a given map has points of one keypoints type, found: {', '.join(types) or 'none'}",
            path=reference.root,
        )
    return types[0]


def check_given_type(reference: KaptureFolder, expected: str) -> None:
    """Check that a given map is of the keypoints type that is extracted for it."""
    found = given_type(reference)
    if found != expected:
        raise DataError(
            f"the given map is of keypoints type {found!r}, given_features extracts {expected!r}",
            path=reference.root,
        )


def has_descriptors(reference: KaptureFolder) -> bool:
    """Whether every image that sees a point of a given map has descriptors; else the images'
    features have to be extracted anew for :func:`given_map`.
    """
    local_type = given_type(reference)
    if local_type not in reference.types("descriptors"):
        return False
    descriptors = reference.descriptors(local_type)
    return all(image in descriptors for image in _observing(reference.observations()[local_type]))


def given_map(reference: KaptureFolder, mapping: KaptureFolder, output: Path) -> dict[str, float]:
    """Write a given map as the map to localize in: features, points and observations.

    Features that are extracted again are those that see points, as the published model names them.
    Points that nothing observes any more are left out.

    Parameters
    ----------
    reference : the given map.
    mapping : its images with what was extracted from them: global features, and local features of
        the map's type where :func:`has_descriptors` says no.

    Returns
    -------
    Counts for the log; ``share_found_again`` is the share of the observations whose keypoints were.
    """
    local_type = given_type(reference)
    seen = reference.observations()[local_type]
    found_again = 1.0
    # what is the reference's own comes first
    source = reference.with_features(mapping.features_dirs)
    if not has_descriptors(reference):
        moved, rows, num_found = _moved(reference, mapping, seen)
        found_again = num_found / len(seen)
        if found_again < _MIN_FOUND_AGAIN:
            raise DataError(
                f"the given map has no descriptors, and of its {len(seen)} observations only "
                f"{found_again:.0%} have a keypoint that extracting {local_type} again finds: it "
                "was made with another detector, other options or other images",
                path=reference.root,
            )
        seen = moved
        _write_rows(mapping, local_type, rows, output)
        source = mapping
    xyz_rgb = reference.points3d()
    kept = np.bincount(seen.point_ids, minlength=len(xyz_rgb)) > 0
    number = np.cumsum(kept) - 1
    write_sensors(output, reference.read())
    link_images(reference.root, output)
    copy_features(source, output, [local_type])  # leaves what is there as it is
    write_points3d(output, xyz_rgb[kept])
    write_observations(output, {local_type: replace(seen, point_ids=number[seen.point_ids])})
    return {
        "images": len(_observing(seen)),
        "points": int(kept.sum()),
        "observations": len(seen),
        "share_found_again": round(found_again, 4),
    }


def _observing(seen: Observations) -> list[str]:
    """Names of the images that observe something, sorted."""
    return [seen.image_names[row] for row in np.unique(seen.image_ids).tolist()]


def _moved(
    reference: KaptureFolder, mapping: KaptureFolder, seen: Observations
) -> tuple[Observations, dict[str, NDArray[np.int64]], int]:
    """Move the observations to the keypoints extracted again.

    An observation whose place has several keypoints (one per orientation) becomes one of each: any
    may be the one that was matched, and all see the point. Returns the observations, whose
    ``keypoint_ids`` count in an image's rows; image -> these rows of its extracted features that
    see points, ascending; and how many of the stored ones were found.
    """
    local_type = seen.keypoints_type
    if local_type not in mapping.types("descriptors"):
        raise DataError(
            f"the given map has no descriptors of type {local_type!r}, and its images' features "
            "have not been extracted again",
            path=mapping.root,
        )
    stored, extracted = reference.keypoints(local_type), mapping.keypoints(local_type)
    order = np.argsort(seen.image_ids, kind="stable")
    ends = np.cumsum(np.bincount(seen.image_ids, minlength=len(seen.image_names)))
    point_ids, image_ids, keypoint_ids = [], [], []
    rows_of, num_found = {}, 0
    for row, rows in enumerate(np.split(order, ends[:-1])):
        image = seen.image_names[row]
        if len(rows) == 0:
            continue
        places = stored.read(image)[seen.keypoint_ids[rows], :2]
        of, keypoints = rows_at_their_places(places, extracted.read(image)[:, :2], _MAX_SHIFT_PX)
        # two stored keypoints of one place that see one point are the same twice
        pairs = np.unique(np.stack([seen.point_ids[rows[of]], keypoints], axis=1), axis=0)
        num_found += len(np.unique(of))
        rows_of[image], numbers = np.unique(pairs[:, 1], return_inverse=True)
        point_ids.append(pairs[:, 0])
        image_ids.append(np.full(len(pairs), row, np.int32))
        keypoint_ids.append(numbers.astype(np.int32))
    points = np.concatenate(point_ids)
    by_point = np.argsort(points, kind="stable")
    observations = replace(
        seen,
        point_ids=points[by_point],
        image_ids=np.concatenate(image_ids)[by_point],
        keypoint_ids=np.concatenate(keypoint_ids)[by_point],
    )
    return observations, rows_of, num_found


def _write_rows(
    mapping: KaptureFolder, local_type: str, rows: dict[str, NDArray[np.int64]], output: Path
) -> None:
    """Write some of the features of the images with a pose, none where ``rows`` has no entry."""
    none = np.zeros(0, np.int64)
    for reader in (mapping.keypoints(local_type), mapping.descriptors(local_type)):
        with FeatureWriter(output, reader.kind, local_type, reader.config) as writer:
            for image in sorted(mapping.read().poses()):
                writer.write(image, reader.read(image)[rows.get(image, none)])


def rows_found_again(
    stored: NDArray[np.float32], extracted: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Row of ``extracted`` (M, 2) for each row of ``stored`` (N, 2), -1 where there is none.

    Each row of ``extracted`` is taken once. Several keypoints may stand at one place with different
    orientations; they are joined in the order both have them.
    """
    if len(stored) == len(extracted) and np.allclose(stored, extracted, atol=1e-3):
        return np.arange(len(stored), dtype=np.int64)
    rows = np.full(len(stored), -1, dtype=np.int64)
    if len(extracted) == 0:
        return rows
    near = cKDTree(extracted).query_ball_point(stored, _SAME_PLACE_PX, return_sorted=True)
    used: set[int] = set()
    for row, candidates in enumerate(near):
        rows[row] = next((one for one in candidates if one not in used), -1)
        used.add(int(rows[row]))
    return rows


def rows_at_their_places(
    stored: NDArray[np.float32], extracted: NDArray[np.float32], max_shift_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All keypoints that stand where the stored ones do: one of ``stored`` may be any of them.

    The place of a stored keypoint is that of the nearest extracted one.

    Parameters
    ----------
    stored, extracted : float32 (N, 2) and (M, 2), pixels.
    max_shift_px : how far the nearest may be.

    Returns
    -------
    Rows of ``stored`` and of ``extracted``, int64 (K,) each, sorted by the first, then the second.
    """
    none = np.zeros(0, dtype=np.int64)
    if len(stored) == 0 or len(extracted) == 0:
        return none, none
    tree = cKDTree(extracted)
    distance, nearest = tree.query(stored)
    found = np.flatnonzero(distance <= max_shift_px)
    near = tree.query_ball_point(extracted[nearest[found]], _SAME_PLACE_PX, return_sorted=True)
    lengths = [len(rows) for rows in near]
    return np.repeat(found, lengths), np.concatenate([none, *near]).astype(np.int64)


def is_given(stage: PipelineStage, local_type: str) -> bool:
    """Whether points of a keypoints type are those of the given map."""
    options = stage.options
    return options.uses_given_map() and local_type == options.make_given_extractor().name


def described_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """The map's images with their features of a type, before there is a map."""
    # descriptors of its own: those that were extracted for it lie in the workspace
    if is_given(stage, local_type) and has_descriptors(work.folder(REFERENCE)):
        return work.folder(REFERENCE, FEATURES)
    return work.folder(stage.layout.mapping(), FEATURES)


def matched_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """The map's images with the features of a type that queries are matched with.

    A given map has keypoints of its own, which are not all that its images' extraction gives.
    """
    if is_given(stage, local_type):
        return work.folder(MAP)
    return work.folder(stage.layout.mapping(), FEATURES, *stage.layout.mapping_matches())


_READ = {
    "keypoints": KaptureFolder.keypoints,
    "descriptors": KaptureFolder.descriptors,
    "global_features": KaptureFolder.global_features,
}
_KINDS: tuple[ArrayKind, ...] = ("keypoints", "descriptors", "global_features")
VOCABULARY_FILE, SETTINGS_FILE = "vocabulary.npy", "vlad.json"
MEAN_FILE, PROJECTION_FILE = "whitening_mean.npy", "whitening_projection.npy"
_VLAD_FILES = (VOCABULARY_FILE, SETTINGS_FILE, MEAN_FILE, PROJECTION_FILE)


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
        for folder, name in product(beside, _VLAD_FILES):
            if (folder / name).is_file() and not (copies / name).exists():
                hard_link(folder / name, copies / name)
    reader = _READ[kind](source, type_name)
    with FeatureWriter(output, kind, type_name, reader.config) as writer:
        for image in images:
            if image not in writer and image in reader:
                writer.write(image, reader.read(image))
