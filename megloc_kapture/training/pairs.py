"""Training pairs: images of kapture data with depth and poses, or views of one photograph.

Sources draw pairs with a given random generator and keep no state, so that a step's pairs depend on
seed and step only. Views of a photograph have random homographies and lighting (DeTone et al., CVPR
workshops 2018, section 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import reduced_size
from megloc_kapture.io.images import image_size, is_image, read_image_rgb
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.mapping.pairs import PairsByPosesOptions, pairs_by_poses
from megloc_kapture.preprocessing.frames import resized, scaled_camera
from megloc_kapture.stages.scene import depth_of, depth_records
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.training.labels import (
    Labels,
    PosedView,
    labels_of_homography,
    labels_of_views,
    overlap,
)

# candidate pairs, before their overlap is measured
_CANDIDATES = PairsByPosesOptions(num_neighbours=40, max_angle_deg=90)
_VIEWS_KEPT = 64
# bounds of the overlap bins; each bin is drawn with equal probability
_OVERLAP_BINS = (0.1, 0.3, 0.5, 0.7)
# views of a photograph: smallest size relative to the largest that fits, largest rotation, and
# largest displacement of the corners as a share of the view's sides
_MIN_SCALE, _MAX_ANGLE_DEG, _PERSPECTIVE = 0.5, 45.0, 0.2

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Labelling = Callable[[NDArray[Any], NDArray[Any]], Labels]
_HALF = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class TrainingPair:
    images: tuple[Image, Image]  # uint8 (H, W, 3), RGB
    keys: tuple[str, str] | None  # cache keys; None for images drawn only once
    label: Labelling  # returns the labels of keypoints (N, 2) and (M, 2) of the images
    # None if a homography relates the images
    views: tuple[PosedView, PosedView] | None = None


class PosedPairs:
    """Pairs of a kapture's images with poses and depth, drawn evenly from bins of overlap.

    ``measured`` is a file of candidate pairs and their overlaps, read if present, else written.
    """

    def __init__(
        self,
        folder: KaptureFolder,
        max_size_px: int,
        work: Work = HERE,
        measured: Path | None = None,
    ) -> None:
        self.folder, self._kapture, self._max_size_px = folder.root, folder, max_size_px
        data = folder.read()
        poses, records = data.poses(), depth_records(data)
        self._poses = poses
        self._names = [name for name in sorted(poses) if name in records]
        for name in self._names:  # a missing image would end the training when it is drawn
            image_size(folder.image_path(name))
        self._view = lru_cache(maxsize=_VIEWS_KEPT)(self._read_view)
        if measured is not None and measured.is_file():
            near, overlaps = self._read_overlaps(measured)
        else:
            near = pairs_by_poses([poses[name] for name in self._names], _CANDIDATES)
            views = ((self._view(self._names[i]), self._view(self._names[j])) for i, j in near)
            shares = work.track((overlap(a, b) for a, b in views), len(near), "overlap")
            overlaps = np.fromiter(shares, np.float64, len(near))
        if not len(near):
            raise DataError(
                "no two images with a pose (trajectories.txt) and a depth map of their timestamp "
                "(records_depth.txt) have viewing directions within "
                f"{_CANDIDATES.max_angle_deg:g} degrees of each other",
                path=folder.root,
            )
        if measured is not None and not measured.is_file():
            named = ((self._names[i], self._names[j]) for i, j in near)
            scored = zip(named, overlaps, strict=True)
            write_pairs(measured, [ImagePair(*names, float(share)) for names, share in scored])
        bounds = pairwise(_OVERLAP_BINS)
        bins = (near[(overlaps >= low) & (overlaps < high)] for low, high in bounds)
        self._bins = [pairs for pairs in bins if len(pairs)]
        if not self._bins:
            raise DataError(
                f"no pair of images overlaps by {_OVERLAP_BINS[0]:g} to "
                f"{_OVERLAP_BINS[-1]:g}; the {len(near)} candidate pairs overlap by "
                f"{overlaps.min():.2f} to {overlaps.max():.2f}",
                path=folder.root,
            )

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        pairs = self._bins[rng.integers(len(self._bins))]
        names = [self._names[row] for row in rng.permuted(pairs[rng.integers(len(pairs))])]
        paths = [self._kapture.image_path(name) for name in names]
        a, b = (self._view(name) for name in names)
        images = [
            resized(read_image_rgb(path), view.camera.width, view.camera.height)
            for path, view in zip(paths, (a, b), strict=True)
        ]
        keys = str(paths[0]), str(paths[1])
        label = partial(labels_of_views, a=a, b=b)
        return TrainingPair((images[0], images[1]), keys, label, (a, b))

    def counts(self) -> dict[str, int]:
        return {"images": len(self._names), "pairs": sum(map(len, self._bins))}

    def _read_overlaps(self, path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        row_of = {name: row for row, name in enumerate(self._names)}
        pairs = read_pairs(path)
        try:
            rows = [(row_of[pair.query], row_of[pair.map]) for pair in pairs]
        except KeyError as error:
            message = f"image {error} lacks a pose or depth in {self.folder}; -f starts over"
            raise DataError(message, path=path) from error
        near = np.array(rows, np.int64).reshape(-1, 2)
        return near, np.array([pair.score for pair in pairs], np.float64)

    def _read_view(self, name: str) -> PosedView:
        camera, depth = self._kapture.read().camera_of(name), depth_of(self._kapture, name)
        assert depth is not None
        size = reduced_size(camera.width, camera.height, self._max_size_px)
        return PosedView(scaled_camera(camera, *size), self._poses[name], depth)


class Photographs:
    """Pairs of views of single photographs: all image files below a folder."""

    def __init__(self, folder: Path, max_size_px: int) -> None:
        self.folder, self._max_size_px = Path(folder), max_size_px
        if not self.folder.is_dir():
            raise DataError("no such folder", path=self.folder)
        self._paths = [path for path in sorted(self.folder.rglob("*")) if is_image(path)]
        if not self._paths:
            raise DataError("no image in this folder", path=self.folder)

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        image = read_image_rgb(self._paths[rng.integers(len(self._paths))])
        size = reduced_size(image.shape[1], image.shape[0], self._max_size_px)
        (a, a_from_image), (b, b_from_image) = (random_view(image, size, rng) for _ in range(2))
        b_from_a = b_from_image @ np.linalg.inv(a_from_image)
        label = partial(labels_of_homography, b_from_a=b_from_a, size_a=size, size_b=size)
        return TrainingPair((relit(a, rng), relit(b, rng)), None, label)

    def counts(self) -> dict[str, int]:
        return {"images": len(self._paths)}


PairSource = PosedPairs | Photographs


def random_view(
    image: Image, size: tuple[int, int], rng: np.random.Generator
) -> tuple[Image, Floats]:
    """Warp a random quadrilateral inside a photograph to a view of the given size (w, h).

    Returns the view, uint8 (h, w, 3), and ``view_from_image``, float64 (3, 3), for pixel
    coordinates with the first pixel's centre at (0.5, 0.5).
    """
    width, height = size
    sides = np.array([image.shape[1], image.shape[0]], np.float64)
    rectangle = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64) * size
    perturbed = rectangle + rng.uniform(-1, 1, (4, 2)) * _PERSPECTIVE * np.array(size)
    angle = np.radians(rng.uniform(-1, 1) * _MAX_ANGLE_DEG)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = (perturbed - rectangle.mean(axis=0)) @ rotation.T
    extent = np.ptp(corners, axis=0)
    # scale to the largest size that fits in the photograph, times a random factor
    corners *= rng.uniform(_MIN_SCALE, 1.0) * (sides / extent).min()
    corners -= corners.min(axis=0)
    corners += rng.uniform(0, 1, 2) * (sides - corners.max(axis=0))
    view_from_image = cv2.getPerspectiveTransform(
        corners.astype(np.float32), rectangle.astype(np.float32)
    )
    # in OpenCV's warp, the first pixel's centre is at (0, 0)
    warp = np.linalg.inv(_HALF) @ view_from_image @ _HALF
    view = cv2.warpPerspective(
        image, warp, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(view, np.uint8), np.asarray(view_from_image, np.float64)


def relit(image: Image, rng: np.random.Generator) -> Image:
    """Change gamma, exposure, colour cast, blur, noise and JPEG quality at random."""
    gamma, exposure = np.exp2(rng.uniform(-1, 1, 2))
    cast = np.exp2(rng.normal(0, 0.12, 3))
    noise, blur = rng.uniform(0, 0.04), rng.uniform(0, 1.2)
    level = (image.astype(np.float32) / 255) ** np.float32(gamma)
    # brightening is limited, because values above white are clipped
    level *= (min(exposure, 1.3) * cast).astype(np.float32)
    if blur > 0.3:
        level = np.asarray(cv2.GaussianBlur(level, (0, 0), float(blur)), np.float32)
    level += rng.normal(0, noise, level.shape).astype(np.float32)
    lit = np.clip(255 * level, 0, 255).astype(np.uint8)
    quality = int(rng.integers(40, 101))
    encodes, encoded = cv2.imencode(".jpg", lit, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8) if encodes else lit
