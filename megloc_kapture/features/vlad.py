"""VLAD: aggregation of local descriptors into one global descriptor.

Each descriptor belongs to the nearest visual word (Jegou et al., CVPR 2010), as in MegLoc.
Intra-normalisation follows Arandjelovic and Zisserman, All about VLAD, CVPR 2013; whitening follows
Jegou and Chum, ECCV 2012.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.values import Options

Float32 = NDArray[np.float32]

_CHUNK = 16384  # descriptors per block: bounds memory at 16384 x clusters floats
# whitening is learnt from at most this many images and this many values (1 GiB of float32)
_WHITENING_IMAGES = 4096
_WHITENING_NUMBERS = 1 << 28
_COLUMNS = 4096  # dimensions per block when whitening is learnt
# variances below this share of the largest are float32 rounding
_LEAST = 1e-9
# whitening divides by standard deviations raised to this power, as AP-GeM does; with 1, as in Jegou
# and Chum, all images of a small map are equally dissimilar
WHITENING_POWER = 0.5
# descriptors that train a vocabulary, the same share of each image's; steps of Lloyd's algorithm
TRAINING_DESCRIPTORS, LLOYD_STEPS = 200_000, 20


class VladOptions(Options):
    num_clusters: int = Field(default=128, gt=0, description="number of visual words")
    dimensions: int | None = Field(
        default=None,
        gt=0,
        description="dimensions after PCA whitening, at most the number of map images minus 1; "
        "none: no whitening",
    )
    seed: int = Field(default=0, ge=0)
    local_type: str | None = Field(
        default=None, description="type of local features to aggregate; none: the run's first type"
    )


def learn_whitening(vectors: Float32, dimensions: int) -> tuple[Float32, Float32]:
    """Learn mean and projection of a whitening from vectors float32 (N, D), which are overwritten.

    Components are divided by their standard deviations raised to ``WHITENING_POWER``, which reduces
    the noise of the last components if images are few (Revaud et al., ICCV 2019). ``dimensions`` is
    limited by the rank of the centred vectors, which is less than N.
    """
    mean = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)
    vectors -= mean
    count, size = vectors.shape
    # the eigenvectors of the D x D covariance follow from those of the N x N Gram matrix
    gram = np.zeros((count, count))
    for start in range(0, size, _COLUMNS):
        part = vectors[:, start : start + _COLUMNS].astype(np.float64)
        gram += part @ part.T
    variances, axes = np.linalg.eigh(gram / count)
    variances, axes = variances[::-1], axes[:, ::-1]
    kept = min(dimensions, count - 1, int((variances > _LEAST * variances[0]).sum()))
    if kept < 1 or variances[0] <= 0:
        raise DataError(
            f"whitening cannot be learnt from {count} images with equal descriptors: use more "
            "images, or no whitening"
        )
    variances, axes = variances[:kept], axes[:, :kept]
    # combine the vectors into unit-length principal axes (D,), divided by powers of the deviations
    rows = (axes / np.sqrt(count * variances) / variances ** (WHITENING_POWER / 2)).T
    projection = np.empty((kept, size), dtype=np.float32)
    for start in range(0, size, _COLUMNS):
        part = vectors[:, start : start + _COLUMNS].astype(np.float64)
        projection[:, start : start + _COLUMNS] = rows @ part
    # fix the sign of each axis: its entry of largest magnitude is positive
    largest = np.take_along_axis(projection, np.abs(projection).argmax(axis=1)[:, None], axis=1)
    projection *= np.where(largest < 0, np.float32(-1), np.float32(1))
    return mean, projection


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Visual words, and an optional PCA whitening of the vectors.

    Attributes
    ----------
    centres : float32 (K, D), the visual words.
    mean, projection : the whitening of a vector x is ``projection (x - mean)``, scaled to unit norm
        (Jegou and Chum, ECCV 2012); None for both means no whitening.
    """

    centres: Float32
    mean: Float32 | None = None
    projection: Float32 | None = None

    @property
    def size(self) -> int:
        return self.centres.size if self.projection is None else len(self.projection)

    def whiten(self, vector: Float32) -> Float32:
        """Whiten one vector (K * D,), if there is a whitening; zero stays zero."""
        if self.mean is None or self.projection is None:
            return vector
        if not vector.any():
            return np.zeros(len(self.projection), dtype=np.float32)
        whitened = self.projection @ (vector - self.mean)
        norm = np.linalg.norm(whitened)
        return whitened / norm if norm > 0 else whitened


Each = Callable[[Callable[[str], Float32], Iterable[str]], Iterable[Float32]]
"""Type of ``map`` or a parallel equivalent."""


def train_vlad(
    images: Sequence[str],
    length: Callable[[str], int],
    read: Callable[[str], NDArray[Any]],
    options: VladOptions | None = None,
    *,
    each: Each = map,
) -> Vocabulary:
    """Train a vocabulary, and optionally a whitening, on the images of a map.

    ``length`` returns the number of an image's descriptors, ``read`` the descriptors themselves,
    (N, D). ``each`` maps a function over images, possibly in parallel.
    """
    options = options or VladOptions()
    rows = sample_rows(map(length, images), TRAINING_DESCRIPTORS, options.seed)
    sampled = [
        np.asarray(read(image)[chosen], dtype=np.float32)
        for image, chosen in zip(images, rows, strict=True)
        if len(chosen)
    ]
    if not sampled:
        raise DataError("the map has no descriptors")
    vocabulary = train_vocabulary(np.concatenate(sampled), options)
    if options.dimensions is None:
        return vocabulary
    del sampled
    most = min(_WHITENING_IMAGES, max(2, _WHITENING_NUMBERS // vocabulary.size))
    described = [image for image, chosen in zip(images, rows, strict=True) if len(chosen)]
    if len(described) > most:  # pick evenly over the sorted names, and so over sequences
        picks = np.linspace(0, len(described) - 1, most).round().astype(np.int64)
        described = [described[pick] for pick in picks]
    vectors = np.empty((len(described), vocabulary.size), dtype=np.float32)
    describe = partial(_read_and_aggregate, read, vocabulary)
    for row, vector in zip(vectors, each(describe, described), strict=True):
        row[:] = vector
    whitening = learn_whitening(vectors, options.dimensions)
    return Vocabulary(vocabulary.centres, *whitening)


def _read_and_aggregate(
    read: Callable[[str], NDArray[Any]], vocabulary: Vocabulary, image: str
) -> Float32:
    return aggregate(read(image), vocabulary)


def train_vocabulary(
    descriptors: NDArray[np.floating[Any]], options: VladOptions | None = None
) -> Vocabulary:
    options = options or VladOptions()
    data = np.ascontiguousarray(descriptors, dtype=np.float32)
    if len(data) < options.num_clusters:
        raise DataError(
            f"a vocabulary of {options.num_clusters} clusters needs at least as many descriptors, "
            f"but the map has {len(data)}: use more images or fewer clusters"
        )
    if not np.isfinite(data).all():
        raise DataError("some of the map's descriptors are not finite")
    rng = np.random.default_rng([options.seed, 0])
    centres = _plus_plus(data, options.num_clusters, rng)
    previous = np.full(len(data), -1, dtype=np.int64)
    for _ in range(LLOYD_STEPS):
        labels = _nearest(data, centres)
        if np.array_equal(labels, previous):
            break
        previous = labels
        sums = _sum_by_label(data, labels, len(centres))
        counts = np.bincount(labels, minlength=len(centres))
        filled = counts > 0
        centres[filled] = (sums[filled] / counts[filled, None]).astype(np.float32)
        for k in np.flatnonzero(~filled):  # an empty cluster restarts at a random descriptor
            centres[k] = data[rng.integers(len(data))]
    return Vocabulary(centres)


def _plus_plus(data: Float32, num_clusters: int, rng: np.random.Generator) -> Float32:
    sample = data
    if len(sample) > 20_000:
        sample = data[np.sort(rng.choice(len(data), 20_000, replace=False))]
    centres = [sample[rng.integers(len(sample))]]
    squared = np.full(len(sample), np.inf)
    for _ in range(num_clusters - 1):
        difference = sample - centres[-1]
        squared = np.minimum(squared, np.einsum("nd,nd->n", difference, difference))
        total = squared.sum()
        if total <= 0:
            raise DataError(
                f"the map has fewer than {num_clusters} distinct descriptors: use fewer clusters"
            )
        centres.append(sample[rng.choice(len(sample), p=squared / total)])
    return np.stack(centres).astype(np.float32)


def _nearest(data: Float32, centres: Float32) -> NDArray[np.int64]:
    half = 0.5 * np.einsum("kd,kd->k", centres, centres)
    labels = np.empty(len(data), dtype=np.int64)
    for start in range(0, len(data), _CHUNK):
        part = data[start : start + _CHUNK]
        labels[start : start + _CHUNK] = np.argmax(part @ centres.T - half, axis=1)
    return labels


def _sum_by_label(
    data: Float32, labels: NDArray[np.int64], num_clusters: int
) -> NDArray[np.float64]:
    order = np.argsort(labels, kind="stable")
    present, starts = np.unique(labels[order], return_index=True)
    sums = np.zeros((num_clusters, data.shape[1]))
    sums[present] = np.add.reduceat(data[order].astype(np.float64), starts, axis=0)
    return sums


def sample_rows(counts: Iterable[int], total: int, seed: int) -> list[NDArray[np.int64]]:
    """Sample the same share of each image's descriptors, about ``total`` in all.

    ``counts`` are the images' numbers of descriptors. Returns the sampled rows of each image.
    """
    counts = list(counts)
    rng = np.random.default_rng(seed)
    everything = sum(counts)
    share = min(1.0, total / everything) if everything else 0.0
    chosen = []
    for count in counts:
        size = min(count, int(np.ceil(count * share)))
        chosen.append(np.sort(rng.choice(count, size, replace=False)).astype(np.int64))
    return chosen


def aggregate(descriptors: NDArray[Any], vocabulary: Vocabulary) -> Float32:
    """Compute the unit-norm VLAD, float32 (M,), of descriptors (N, D); zero if N is 0."""
    data = np.ascontiguousarray(descriptors, dtype=np.float32)
    centres = vocabulary.centres
    if len(data) and data.shape[1] != centres.shape[1]:
        raise DataError(
            f"descriptors have {data.shape[1]} dimensions, "
            f"but the vocabulary has {centres.shape[1]}"
        )
    if len(data) == 0:
        return np.zeros(vocabulary.size, dtype=np.float32)
    labels = _nearest(data, centres)
    counts = np.bincount(labels, minlength=len(centres))[:, None]
    residuals = _sum_by_label(data, labels, len(centres)) - counts * centres
    vector = _unit(_unit(residuals).ravel())
    # normalise again, since the first division rounds the length
    return vocabulary.whiten(_unit(vector).astype(np.float32))


def _unit(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    norm = np.linalg.norm(values, axis=-1, keepdims=True)
    return np.asarray(np.divide(values, norm, out=np.zeros_like(values), where=norm > 1e-12))
