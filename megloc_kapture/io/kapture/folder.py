"""Lazy, read-only access to a kapture folder."""

from __future__ import annotations

import filecmp
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import safe_join
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture.features import (
    ArrayKind,
    FeatureKind,
    FeatureReader,
    feature_folder,
    features_dir_hint,
    list_types,
)
from megloc_kapture.io.kapture.matches import MatchesReader
from megloc_kapture.io.kapture.points import Observations, read_observations, read_points3d
from megloc_kapture.io.kapture.sensors import KaptureData, read_kapture_data

ARRAY_KINDS: tuple[ArrayKind, ...] = ("keypoints", "descriptors", "global_features")


class KaptureFolder:
    """Lazy, read-only access to a kapture folder and to feature folders in the orphan layout.

    Features in the kapture folder take precedence. A pickle contains only paths; a process that
    unpickles a folder several times opens it once.
    """

    def __init__(self, root: Path | str, *, features_dirs: Sequence[Path | str] = ()) -> None:
        self.root = Path(root)
        self.features_dirs = tuple(Path(d) for d in features_dirs)
        self._points_path = self.root / "reconstruction" / "points3d.txt"
        self._observations_path = self.root / "reconstruction" / "observations.txt"
        self._data: KaptureData | None = None
        self._points: NDArray[np.float64] | None = None
        self._observations: dict[str, Observations] | None = None
        self._id = uuid4().hex

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (self.root, self.features_dirs, self._id)

    def with_features(self, features_dirs: Sequence[Path | str]) -> KaptureFolder:
        """Return the same kapture folder with different feature folders."""
        return KaptureFolder(self.root, features_dirs=features_dirs)

    def check_features_apart(self, other: KaptureFolder) -> None:
        """Raise DataError if different images of the same name have the same features in both."""
        shared = sorted(set(self.read().image_names()) & set(other.read().image_names()))
        different = [
            i for i in shared if not _same_content(self.image_path(i), other.image_path(i))
        ]
        for kind in ARRAY_KINDS if different else ():
            for type_name in sorted(set(self.types(kind)) & set(other.types(kind))):
                mine, theirs = (folder.features(kind, type_name) for folder in (self, other))
                for image in different:
                    if image in mine and image in theirs and _same_array(mine, theirs, image):
                        raise DataError(
                            f"{image} is a different image in {self.root} than in {other.root}, "
                            f"but both would get these {kind}; give each folder a separate "
                            "--features-dir, or rename one image",
                            path=theirs.where(image),
                        )

    def read(self) -> KaptureData:
        """Return sensors, rigs, trajectories and records; parsed once."""
        if self._data is None:
            self._data = read_kapture_data(self.root)
        return self._data

    def image_path(self, image: str) -> Path:
        """Return the path of an image, which need not exist and may be a link."""
        return safe_join(self.root / "sensors" / "records_data", image)

    def depth_path(self, name: str) -> Path:
        return self.image_path(name)

    def types(self, kind: FeatureKind) -> list[str]:
        types = set(list_types(self.root, kind, orphan=False))
        for folder in self.features_dirs:
            types.update(list_types(folder, kind, orphan=True))
        return sorted(types)

    def features(self, kind: ArrayKind, type_name: str) -> FeatureReader:
        return FeatureReader(kind, type_name, self._folders(kind, type_name))

    def keypoints(self, type_name: str) -> FeatureReader:
        return self.features("keypoints", type_name)

    def descriptors(self, type_name: str) -> FeatureReader:
        return self.features("descriptors", type_name)

    def global_features(self, type_name: str) -> FeatureReader:
        return self.features("global_features", type_name)

    def matches(self, type_name: str) -> MatchesReader:
        return MatchesReader(type_name, self._folders("matches", type_name))

    def has_points(self) -> bool:
        return self._points_path.is_file() and self._observations_path.is_file()

    def points3d(self) -> NDArray[np.float64]:
        """Return 3D points, float64 (N, 6): X Y Z R G B (0 if missing); cached, read-only."""
        if self._points is None:
            points = read_points3d(self._points_path)
            points.setflags(write=False)
            self._points = points
        return self._points

    def observations(self) -> dict[str, Observations]:
        """Return the observations of the 3D points by keypoints type; cached, read-only."""
        if self._observations is None:
            by_type = read_observations(self._observations_path)
            for keypoints_type, of_type in by_type.items():
                self._check_observations(keypoints_type, of_type)
                for array in (of_type.point_ids, of_type.image_ids, of_type.keypoint_ids):
                    array.setflags(write=False)
            self._observations = by_type
        return dict(self._observations)

    def validate(self, *, deep: bool = False) -> None:
        """Cross-check sensors, features and points and, if ``deep``, also images and matches."""
        self.read()
        readers = {
            kind: {name: self.features(kind, name) for name in self.types(kind)}
            for kind in ARRAY_KINDS
        }
        for of_kind in readers.values():
            for reader in of_kind.values():
                for image in reader.names:
                    reader.read(image)
        for descriptors in readers["descriptors"].values():
            self._check_descriptors(descriptors, readers["keypoints"])
        for type_name in self.types("matches"):
            matches = self.matches(type_name)
            pairs = matches.pairs
            if deep:
                self._check_matches(matches, pairs, readers["keypoints"].get(type_name))
        if self._observations_path.exists() or self._points_path.exists():
            self.points3d()
        if self._observations_path.exists():
            self.observations()
        if deep:
            for image in self.read().image_names():
                read_image_rgb(self.image_path(image))

    def _folders(self, kind: FeatureKind, type_name: str) -> list[Path]:
        candidates = [(self.root, False), *((folder, True) for folder in self.features_dirs)]
        folders = [
            feature_folder(root, kind, type_name, orphan=orphan)
            for root, orphan in candidates
            if type_name in list_types(root, kind, orphan=orphan)
        ]
        if not folders:
            searched = ", ".join(str(root) for root, _ in candidates)
            present = ", ".join(self.types(kind)) or "none"
            raise DataError(
                f"no {kind} of type {type_name!r} in {searched}; there are: {present} "
                f"({features_dir_hint(kind)})"
            )
        return folders

    def _check_descriptors(
        self, descriptors: FeatureReader, keypoints_by_type: dict[str, FeatureReader]
    ) -> None:
        keypoints_type = cast(str, descriptors.config.keypoints_type)
        # converters may write another tool's name for the type (OpenMVG: SIFT_Regions)
        if keypoints_type not in keypoints_by_type:
            keypoints_type = descriptors.type_name
        keypoints = keypoints_by_type.get(keypoints_type)
        for image in descriptors.names:
            if keypoints is None or image not in keypoints:
                raise DataError(
                    f"image {image!r} has descriptors but no keypoints of type {keypoints_type!r}",
                    path=descriptors.where(image),
                )
            require(
                descriptors.length(image) == keypoints.length(image),
                f"{descriptors.length(image)} descriptors for {keypoints.length(image)} keypoints",
                path=descriptors.where(image),
            )

    def _check_matches(
        self,
        matches: MatchesReader,
        pairs: Sequence[tuple[str, str]],
        keypoints: FeatureReader | None,
    ) -> None:
        for pair in pairs:
            indices, _ = matches.read(*pair)
            for image, column in zip(pair, indices.T, strict=True):
                if keypoints is None or image not in keypoints or len(column) == 0:
                    continue
                require(
                    column.max() < keypoints.length(image),
                    f"matches of {pair[0]!r} and {pair[1]!r} (type {matches.type_name!r}) "
                    f"refer to keypoints that {image!r} does not have",
                )

    def _check_observations(self, keypoints_type: str, observations: Observations) -> None:
        num_points = len(self.points3d())
        limit = np.full(len(observations.image_names), np.iinfo(np.int32).max, dtype=np.int64)
        if keypoints_type in self.types("keypoints"):
            keypoints = self.keypoints(keypoints_type)
            for index, image in enumerate(observations.image_names):
                if image in keypoints:
                    limit[index] = keypoints.length(image)
        wrong = observations.point_ids >= num_points
        wrong |= observations.keypoint_ids >= limit[observations.image_ids]
        for first in np.flatnonzero(wrong)[:1].tolist():
            image = observations.image_ids[first]
            raise DataError(
                f"point {observations.point_ids[first]}, keypoint "
                f"{observations.keypoint_ids[first]} of {observations.image_names[image]!r}: there "
                f"are {num_points} points and {limit[image]} keypoints of type {keypoints_type!r}",
                path=self._observations_path,
            )


@lru_cache(maxsize=8)
def _unpickled(root: Path, features_dirs: tuple[Path, ...], folder_id: str) -> KaptureFolder:
    return KaptureFolder(root, features_dirs=features_dirs)


def _same_content(first: Path, second: Path) -> bool:
    try:
        return first.samefile(second) or filecmp.cmp(first, second, shallow=False)
    except OSError:
        return False


def _same_array(first: FeatureReader, second: FeatureReader, image: str) -> bool:
    try:
        a, b = first.read(image), second.read(image)
    except DataError:
        return False
    return a.size > 0 and a.shape == b.shape and a.tobytes() == b.tobytes()
