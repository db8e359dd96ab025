"""Files of guided pyramid matching: what variants found, until all did, and type ``T-pyramid``."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from megloc_kapture.geometry.image_variants import ImageVariant
from megloc_kapture.io.files import hard_link, output_error
from megloc_kapture.io.kapture import FeatureReader, FeatureWriter
from megloc_kapture.io.kapture.features import SUFFIX, feature_folder
from megloc_kapture.matching.guided_pyramid import VariantMatches, pyramid_type


@dataclass(frozen=True)
class Spooled:
    """Where in the spool the matches of a variant lie."""

    variant: ImageVariant
    count: int
    keypoints_at: int
    rows_at: int
    scores_at: int
    descriptors_at: int

    def descriptor_at(self, match: int, row_bytes: int) -> int:
        """Where the descriptor of one of its matches begins."""
        return self.descriptors_at + match * row_bytes


class MatchSpool:
    """Variants' matches on disk until all are there: a large map's are too many for memory.

    A file without a name below ``folder``, gone when it is closed. Use as a context manager.
    """

    def __init__(self, folder: Path, keypoints: FeatureReader, descriptors: FeatureReader) -> None:
        self._columns = keypoints.config.dsize
        self._values = descriptors.config.dsize
        self._descriptor_type = descriptors.config.dtype
        self.row_bytes = descriptors.config.row_bytes
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by __exit__
        except OSError as error:
            raise output_error(folder, error) from error
        self._end = 0

    def __enter__(self) -> MatchSpool:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def put(self, matches: VariantMatches) -> Spooled:
        """Keep the matches of a variant; raises OutputError where the disk is full."""
        parts = (
            np.ascontiguousarray(matches.keypoints_px, np.float32),
            np.ascontiguousarray(matches.other_rows, np.int64),
            np.ascontiguousarray(matches.scores, np.float32),
            np.ascontiguousarray(matches.descriptors, self._descriptor_type),
        )
        places = []
        for part in parts:
            places.append(self._end)
            try:
                self._end += self._file.write(part.tobytes())
            except OSError as error:
                raise output_error(self._folder, error) from error
        return Spooled(matches.variant, len(matches), *places)

    def get(self, place: Spooled) -> VariantMatches:
        """The matches that were put there, without their descriptors."""
        return VariantMatches(
            place.variant,
            self._read(place.keypoints_at, (place.count, self._columns), np.float32),
            np.zeros((place.count, 0), self._descriptor_type),
            self._read(place.rows_at, (place.count,), np.int64),
            self._read(place.scores_at, (place.count,), np.float32),
        )

    def descriptors(self, places: list[int]) -> NDArray[Any]:
        """Descriptors (N, D) by where they begin."""
        found = np.empty((len(places), self._values), self._descriptor_type)
        for row, at in enumerate(places):
            found[row] = self._read(at, (self._values,), self._descriptor_type)
        return found

    def _read(self, at: int, shape: tuple[int, ...], kind: DTypeLike) -> NDArray[Any]:
        self._file.seek(at)
        dtype = np.dtype(kind)
        content = self._file.read(int(np.prod(shape)) * dtype.itemsize)
        return np.frombuffer(content, dtype).reshape(shape)


class PyramidFeatures:
    """Writes the type ``T-pyramid``: of each image the features of T, then those added.

    Files of images that nothing was added to are hard links to those of T where the file system
    has them, so that they take no space twice.
    """

    def __init__(self, output: Path, keypoints: FeatureReader, descriptors: FeatureReader) -> None:
        name = pyramid_type(keypoints.type_name)
        self._sources = (keypoints, descriptors)
        # the name in the files stays that of the method: by it the extractor is found again
        self._writers = (
            FeatureWriter(output, "keypoints", name, keypoints.config, orphan=True),
            FeatureWriter(
                output,
                "descriptors",
                name,
                replace(descriptors.config, keypoints_type=name),
                orphan=True,
            ),
        )
        self._folders = [
            feature_folder(output, kind, name, orphan=True) for kind in ("keypoints", "descriptors")
        ]

    def write(
        self, image: str, added_px: NDArray[np.float32], added_descriptors: NDArray[Any]
    ) -> None:
        """Write an image's features, with those added to it; raises OutputError."""
        added = (added_px, added_descriptors)
        for source, writer, folder, more in zip(
            self._sources, self._writers, self._folders, added, strict=True
        ):
            place = folder / f"{image}{SUFFIX[source.kind]}"
            stored = Path(source.where(image))
            if len(more) == 0 and stored.is_file():  # else it is a member of a tar
                hard_link(stored, place)
                continue
            writer.write(image, np.concatenate([source.read(image), more]))
