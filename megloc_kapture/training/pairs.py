"""Pairs of images to train on: of a kapture with depth and poses, or views of photographs.

A source draws pairs at random from a generator that it is given, and keeps no state of its own: the
pair of a step depends on the seed and the step, so that training goes on where it was interrupted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import read_content
from megloc_kapture.io.images import WRITABLE_SUFFIXES, read_depth_map, read_image_rgb
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.mapping.pairs import PairsByPosesOptions, pairs_by_poses
from megloc_kapture.plugins import DepthView
from megloc_kapture.preprocessing.frames import resized, scaled_camera
from megloc_kapture.stages.rigs import depth_records
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.training.homographies import HomographyOptions, random_view, relit
from megloc_kapture.training.labels import (
    LabelOptions,
    Labels,
    PosedView,
    labels_of_homography,
    labels_of_views,
    overlap,
)
from megloc_kapture.values import Options, RigidTransform

# near images that look anything like the same way; their overlap is then measured
_CANDIDATES = PairsByPosesOptions(num_neighbours=40, max_angle_deg=90)
_VIEWS_KEPT = 64

Image = NDArray[np.uint8]
Labelling = Callable[[NDArray[Any], NDArray[Any]], Labels]


class PairOptions(Options):
    """Options of pairs and their labels."""

    max_size_px: int = Field(
        default=640, ge=64, description="longer side that images are reduced to"
    )
    overlap_bins: tuple[float, ...] = Field(
        default=(0.1, 0.3, 0.5, 0.7),
        description="bounds of the bins of measured overlap; a pair is drawn from each alike",
    )
    homographies: HomographyOptions = HomographyOptions()
    labels: LabelOptions = LabelOptions()

    @field_validator("overlap_bins")
    @classmethod
    def _ascend(cls, bounds: tuple[float, ...]) -> tuple[float, ...]:
        if len(bounds) < 2 or bounds[0] < 0 or any(a >= b for a, b in pairwise(bounds)):
            raise ValueError("overlap_bins are two or more shares, each larger than the one before")
        return bounds


@dataclass(frozen=True, eq=False)
class TrainingPair:
    """Two images, and how the keypoints that are found in them are labelled.

    Attributes
    ----------
    images : uint8 (H, W, 3), RGB.
    keys : of images that come again as they are; None of those that do not.
    label : labels of keypoints (N, 2) and (M, 2) of the images.
    views : cameras, poses and depth of a pair of posed images; None under a homography.
    """

    images: tuple[Image, Image]
    keys: tuple[str, str] | None
    label: Labelling
    views: tuple[PosedView, PosedView] | None = None

    @property
    def b_from_a(self) -> RigidTransform | None:
        """Relative pose of posed images."""
        if self.views is None:
            return None
        a, b = self.views
        return b.cam_from_world @ a.cam_from_world.inverse()


class PairSource(Protocol):
    """Where pairs come from."""

    folder: Path

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """A pair, by the generator's numbers; raises DataError for a broken file."""
        ...

    def files(self) -> Iterable[Path]:
        """All files that pairs are made of, sorted."""
        ...

    def counts(self) -> dict[str, int]:
        """What there is, for the manifest."""
        ...


class PosedPairs:
    """Pairs of a kapture's images that have poses and depth, by the overlap of what they show.

    Parameters
    ----------
    measured : file of pairs with their overlap as score; it is read where it is there, else made.

    Raises
    ------
    DataError : fewer than two images have a pose and depth, or no two overlap as asked for; or the
        file of overlaps is of other images.
    """

    def __init__(
        self,
        folder: KaptureFolder,
        options: PairOptions,
        work: Work = HERE,
        measured: Path | None = None,
    ) -> None:
        self.folder, self._kapture, self._options = folder.root, folder, options
        data = folder.read()
        poses, records = data.poses(), depth_records(data)
        self._poses, self._records = poses, records
        self._names = [name for name in sorted(poses) if name in records]
        # bound to this object, so that it goes with it
        self._view = lru_cache(maxsize=_VIEWS_KEPT)(self._read_view)
        if measured is not None and measured.is_file():
            near, overlaps = self._read_overlaps(measured)
        else:
            near = pairs_by_poses([poses[name] for name in self._names], _CANDIDATES)
            found = work.track((self._overlap(i, j) for i, j in near), len(near), "overlap")
            overlaps = np.fromiter(found, np.float64, len(near))
        if not len(near):
            raise DataError(
                "no two images have a pose and a depth map of their moment (trajectories.txt, "
                "records_depth.txt)",
                path=folder.root,
            )
        if measured is not None and not measured.is_file():
            named = ((self._names[i], self._names[j]) for i, j in near)
            scored = zip(named, overlaps, strict=True)
            write_pairs(measured, [ImagePair(*names, float(share)) for names, share in scored])
        self._bins = [
            near[(overlaps >= low) & (overlaps < high)]
            for low, high in pairwise(options.overlap_bins)
        ]
        self._bins = [pairs for pairs in self._bins if len(pairs)]
        if not self._bins:
            raise DataError(
                f"no pair of images overlaps by {options.overlap_bins[0]:g} to "
                f"{options.overlap_bins[-1]:g}; the {len(near)} that are near overlap by "
                f"{overlaps.min():.2f} to {overlaps.max():.2f}",
                path=folder.root,
            )

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        pairs = self._bins[rng.integers(len(self._bins))]
        names = [self._names[row] for row in rng.permuted(pairs[rng.integers(len(pairs))])]
        a, b = (self._view(name) for name in names)
        images = [
            resized(read_image_rgb(self._kapture.image_path(name)), *_size(view))
            for name, view in zip(names, (a, b), strict=True)
        ]
        keys = (str(self._kapture.image_path(names[0])), str(self._kapture.image_path(names[1])))
        labels = self._options.labels
        return TrainingPair(
            (images[0], images[1]),
            keys,
            lambda px_a, px_b: labels_of_views(px_a, px_b, a, b, labels),
            (a, b),
        )

    def files(self) -> list[Path]:
        sensors = sorted((self.folder / "sensors").glob("*.txt"))
        images = [self._kapture.image_path(name) for name in self._names]
        depth = [self._kapture.depth_path(self._records[name].path) for name in self._names]
        return [*sensors, *images, *depth]

    def counts(self) -> dict[str, int]:
        return {"images": len(self._names), "pairs": sum(map(len, self._bins))}

    def _read_overlaps(self, path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        row_of = {name: row for row, name in enumerate(self._names)}
        pairs = read_pairs(path)
        if not all(one.query in row_of and one.map in row_of for one in pairs):
            raise DataError(f"is not of the images of {self.folder}", path=path)
        rows = [(row_of[one.query], row_of[one.map]) for one in pairs]
        near = np.array(rows, np.int64).reshape(-1, 2)
        return near, np.array([one.score for one in pairs], np.float64)

    def _overlap(self, first: int, second: int) -> float:
        a, b = self._view(self._names[first]), self._view(self._names[second])
        return overlap(a, b, self._options.labels)

    def _read_view(self, name: str) -> PosedView:
        camera, record = self._kapture.read().camera_of(name), self._records[name]
        size = reduced_size(camera.width, camera.height, self._options.max_size_px)
        depth_m = read_depth_map(
            self._kapture.depth_path(record.path),
            width=record.camera.width,
            height=record.camera.height,
        )
        return PosedView(
            scaled_camera(camera, *size),
            self._poses[name],
            DepthView(record.camera, depth_m, record.image_from_depth),
        )


class Photographs:
    """Pairs of views of single photographs, of all image files below a folder.

    Raises
    ------
    DataError : there is no such folder, or no image in it.
    """

    def __init__(self, folder: Path, options: PairOptions) -> None:
        self.folder, self._options = Path(folder), options
        if not self.folder.is_dir():
            raise DataError("no such folder", path=self.folder)
        self._paths = [
            path
            for path in sorted(self.folder.rglob("*"))
            if path.suffix.lower() in WRITABLE_SUFFIXES and path.is_file()
        ]
        if not self._paths:
            raise DataError("no image in this folder", path=self.folder)

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        image = read_image_rgb(self._paths[rng.integers(len(self._paths))])
        options = self._options.homographies
        size = reduced_size(image.shape[1], image.shape[0], self._options.max_size_px)
        (a, a_from_image), (b, b_from_image) = (
            random_view(image, size, rng, options) for _ in range(2)
        )
        b_from_a = b_from_image @ np.linalg.inv(a_from_image)
        labels = self._options.labels
        return TrainingPair(
            (relit(a, rng, options.light), relit(b, rng, options.light)),
            None,
            lambda px_a, px_b: labels_of_homography(px_a, px_b, b_from_a, size, size, labels),
        )

    def files(self) -> list[Path]:
        return self._paths

    def counts(self) -> dict[str, int]:
        return {"images": len(self._paths)}


def reduced_size(width: int, height: int, max_size_px: int) -> tuple[int, int]:
    """Width and height of an image that is reduced to a longer side; itself where it is smaller."""
    scale = min(1.0, max_size_px / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def sha256_of_files(root: Path, paths: Sequence[Path]) -> str:
    """One checksum of the names below a folder and the contents of files."""
    digest = hashlib.sha256()
    for path in paths:
        content = hashlib.sha256(read_content(path)).hexdigest()
        digest.update(f"{path.relative_to(root).as_posix()} {content}\n".encode())
    return digest.hexdigest()


def _size(view: PosedView) -> tuple[int, int]:
    return view.camera.width, view.camera.height
