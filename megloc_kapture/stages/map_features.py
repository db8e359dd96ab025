"""Features of map images: copies for new maps, and extracted features for models without them.

A model without descriptors, for example from COLMAP, stores only keypoint positions. Its
observations are transferred to extracted keypoints at the same positions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.errors import require
from megloc_kapture.io.files import hard_link, link_images
from megloc_kapture.io.kapture import (
    FeatureWriter,
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.features import ArrayKind
from megloc_kapture.io.kapture.folder import ARRAY_KINDS
from megloc_kapture.io.kapture.points import rows_by_id

# detector implementations differ by tenths of a pixel
_MAX_SHIFT_PX = 1.0
# smallest proportion of observations with an extracted keypoint at their position
_MIN_FOUND_AGAIN = 0.5
# keypoints that differ only in orientation have equal positions up to rounding
_SAME_PLACE_PX = 0.1


def move_points(
    model: KaptureFolder, mapping: KaptureFolder, local_type: str, output: Path
) -> dict[str, float]:
    """Write a model as a map with the features of ``mapping``; return counts for the log.

    Only keypoints that observe a point are kept; points without observations are dropped.
    """
    seen = model.observations()[local_type]
    moved, rows_of, num_found = _moved(model, mapping, local_type, seen)
    require(
        num_found >= _MIN_FOUND_AGAIN * len(seen),
        f"the model has no descriptors, and extracting {local_type} again finds keypoints "
        f"for only {num_found / len(seen):.0%} of its {len(seen)} observations: it "
        "was made with another detector, other options or other images",
        path=model.root,
    )
    none = np.zeros(0, np.int64)
    for reader in (mapping.keypoints(local_type), mapping.descriptors(local_type)):
        writer = FeatureWriter(output, reader.kind, local_type, reader.config)
        for image in sorted(mapping.read().poses()):
            writer.write(image, reader.read(image)[rows_of.get(image, none)])
    xyz_rgb = model.points3d()
    kept = np.bincount(moved.point_ids, minlength=len(xyz_rgb)) > 0
    number = np.cumsum(kept) - 1
    moved = replace(moved, point_ids=number[moved.point_ids])
    write_map(model, output, xyz_rgb[kept], {local_type: moved})
    return {
        "images": len(np.unique(moved.image_ids)),
        "points": int(kept.sum()),
        "observations": len(moved),
        "share_found_again": round(num_found / len(seen), 4),
    }


def write_map(
    source: KaptureFolder,
    output: Path,
    points: NDArray[np.float64],
    observations: Mapping[str, Observations],
) -> None:
    """Write the sensors, poses and images (links) of ``source``, and new points and observations.

    ``points`` (N, 6) have colours, 0 where unknown.
    """
    write_sensors(output, source.read())
    link_images(source.root, output)
    write_points3d(output, points)
    write_observations(output, observations)


def _moved(
    reference: KaptureFolder, mapping: KaptureFolder, local_type: str, seen: Observations
) -> tuple[Observations, dict[str, NDArray[np.int64]], int]:
    """Transfer observations to all extracted keypoints at the same position (one per orientation).

    Return the new observations, the rows of the kept keypoints by image, and the number of stored
    observations that were transferred. The new keypoint ids are positions among the kept rows.
    """
    stored, extracted = reference.keypoints(local_type), mapping.keypoints(local_type)
    point_ids, image_ids, keypoint_ids = [], [], []
    rows_of, num_found = {}, 0
    for row, rows in enumerate(rows_by_id(seen.image_ids, len(seen.image_names))):
        image = seen.image_names[row]
        if len(rows) == 0:
            continue
        places = stored.read(image)[seen.keypoint_ids[rows], :2]
        of, keypoints = rows_at_their_places(places, extracted.read(image)[:, :2], _MAX_SHIFT_PX)
        # stored keypoints that observe one point at one position are duplicates
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


def rows_found_again(
    stored: NDArray[np.float32], extracted: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Return the row of ``extracted`` (M, 2) for each row of ``stored`` (N, 2), or -1.

    Each extracted row is used at most once. Keypoints that have equal positions and different
    orientations are assigned in order.
    """
    rows, used = np.full(len(stored), -1, dtype=np.int64), set[int]()
    of, again = rows_at_their_places(stored, extracted, _MAX_SHIFT_PX)
    for row, candidate in zip(of.tolist(), again.tolist(), strict=True):
        if rows[row] < 0 and candidate not in used:
            rows[row] = candidate
            used.add(candidate)
    return rows


def rows_at_their_places(
    stored: NDArray[np.float32], extracted: NDArray[np.float32], max_shift_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs of stored (N, 2) and extracted (M, 2) keypoints at the same position.

    A stored keypoint is paired with its nearest extracted keypoint, if that is within
    ``max_shift_px``, and with all extracted keypoints at the position of the nearest. Return stored
    and extracted rows, int64 (K,) each, sorted by stored row, then extracted row.
    """
    none = np.zeros(0, dtype=np.int64)
    if len(stored) == 0 or len(extracted) == 0:
        return none, none
    tree = cKDTree(extracted)
    distance, nearest = tree.query(stored)
    close = np.flatnonzero(distance <= max_shift_px)
    near = tree.query_ball_point(extracted[nearest[close]], _SAME_PLACE_PX, return_sorted=True)
    lengths = [len(rows) for rows in near]
    return np.repeat(close, lengths), np.concatenate([none, *near]).astype(np.int64)


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
    """Add features of the map images to the kapture at ``output``.

    Files are hard-linked where possible. Features inside the source folder are user data and are
    copied, unless ``link_own`` is set. ``local_types`` does not restrict global features.
    """
    wanted = None if local_types is None else set(local_types)
    for kind in ARRAY_KINDS:
        for name in source.types(kind):
            if kind == "global_features" or wanted is None or name in wanted:
                _copy_type(source, output, kind, name, link_own=link_own)


def _copy_type(
    source: KaptureFolder, output: Path, kind: ArrayKind, type_name: str, *, link_own: bool
) -> None:
    reader, reconstruction = source.features(kind, type_name), source.root / "reconstruction"
    writer = FeatureWriter(output, kind, type_name, reader.config)
    for image in filter(reader.__contains__, source.read().image_names()):
        is_own = Path(reader.where(image)).is_relative_to(reconstruction)
        writer.copy(image, reader, link=link_own or not is_own)
    if kind == "global_features":
        copies = output / "reconstruction" / kind / type_name
        folders = [root / kind / type_name for root in (reconstruction, *source.features_dirs)]
        for folder, name in product(folders, _VLAD_FILES):
            if (folder / name).is_file() and not (copies / name).exists():
                hard_link(folder / name, copies / name)
