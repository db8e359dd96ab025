"""Features of map images: reuse of a prebuilt map's features, and copies into new maps.

Without published descriptors, features are extracted again and the observations are transferred to
the keypoints at the same positions.
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

# detector implementations differ by some tenths of a pixel
_MAX_SHIFT_PX = 1.0
_MIN_FOUND_AGAIN = 0.5
# identical keypoints only differ by rounding
_SAME_PLACE_PX = 0.1


def given_type(reference: KaptureFolder) -> str:
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
    found = given_type(reference)
    if found != expected:
        raise DataError(
            f"the given map is of keypoints type {found!r}, given_features extracts {expected!r}",
            path=reference.root,
        )


def has_descriptors(reference: KaptureFolder) -> bool:
    """Return whether every image that observes points has descriptors."""
    local_type = given_type(reference)
    if local_type not in reference.types("descriptors"):
        return False
    descriptors = reference.descriptors(local_type)
    return all(image in descriptors for image in _observing(reference.observations()[local_type]))


def given_map(reference: KaptureFolder, mapping: KaptureFolder, output: Path) -> dict[str, float]:
    """Write a prebuilt map as the map to localize in; return counts for the log.

    ``mapping`` has extracted global features, and local features unless :func:`has_descriptors`.
    Of these only keypoints that see points are kept; points without observations are dropped.
    """
    local_type = given_type(reference)
    seen = reference.observations()[local_type]
    found_again = 1.0
    # the reference's features take precedence
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
    copy_features(source, output, [local_type])
    write_points3d(output, xyz_rgb[kept])
    write_observations(output, {local_type: replace(seen, point_ids=number[seen.point_ids])})
    return {
        "images": len(_observing(seen)),
        "points": int(kept.sum()),
        "observations": len(seen),
        "share_found_again": round(found_again, 4),
    }


def _observing(seen: Observations) -> list[str]:
    return [seen.image_names[row] for row in np.unique(seen.image_ids).tolist()]


def _moved(
    reference: KaptureFolder, mapping: KaptureFolder, seen: Observations
) -> tuple[Observations, dict[str, NDArray[np.int64]], int]:
    """Transfer observations to all extracted keypoints at the same position (one per orientation).

    Return observations that index the kept rows, these rows by image, and the transferred number.
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
        # stored keypoints at one position that see one point are duplicates
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
    none = np.zeros(0, np.int64)
    for reader in (mapping.keypoints(local_type), mapping.descriptors(local_type)):
        with FeatureWriter(output, reader.kind, local_type, reader.config) as writer:
            for image in sorted(mapping.read().poses()):
                writer.write(image, reader.read(image)[rows.get(image, none)])


def rows_found_again(
    stored: NDArray[np.float32], extracted: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Return the row of ``extracted`` (M, 2) for each row of ``stored`` (N, 2), or -1.

    Each extracted row is used once. Keypoints at one position with different orientations are
    assigned in order.
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
    """Return all pairs of stored (N, 2) and extracted (M, 2) keypoints at the same position.

    The position of a stored keypoint is that of the nearest extracted one within ``max_shift_px``.
    Return rows of both, int64 (K,) each, sorted by the first, then the second.
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
    options = stage.options
    return options.uses_given_map() and local_type == options.make_given_extractor().name


def described_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """Open the map images with features of a type, before the map is made."""
    # otherwise the extracted descriptors are in the workspace
    if is_given(stage, local_type) and has_descriptors(work.folder(REFERENCE)):
        return work.folder(REFERENCE, FEATURES)
    return work.folder(stage.layout.mapping(), FEATURES)


def matched_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """Open the map images with the features that queries are matched with."""
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
    """Add features of the map images to the kapture at ``output`` without overwriting.

    Files are hard links where possible. The source's internal features are user data and copied,
    unless ``link_own``. ``local_types`` does not restrict global features.
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
            if image not in kept and file.is_file() and not copy.exists():
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
