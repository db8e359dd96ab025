"""Stage: VLAD of every image from its local descriptors, as a kapture global feature.

The vocabulary is trained on the map's descriptors and stored beside the vectors, so that queries
that come later get theirs from the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.vlad import (
    PcaWhitening,
    VladOptions,
    Vocabulary,
    aggregate,
    train_vlad,
)
from megloc_kapture.io.files import read_json_model, write_json_model
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.stages.kept_items import feature_inputs
from megloc_kapture.stages.shared_index import write_array
from megloc_kapture.stages.work import HERE, FolderSpec, Work, ordered_map
from megloc_kapture.values import Options

VOCABULARY_FILE = "vocabulary.npy"
MEAN_FILE, PROJECTION_FILE = "whitening_mean.npy", "whitening_projection.npy"
SETTINGS_FILE = "vlad.json"


class VladSettings(Options):
    """What ``vlad.json`` says: how the vectors beside it were made."""

    local_type: str
    options: VladOptions


@dataclass(frozen=True)
class _Descriptors:
    """Reads descriptors, here or in a worker."""

    folder: FolderSpec
    local_type: str

    def __call__(self, image: str) -> NDArray[Any]:
        return self.folder.open().descriptors(self.local_type).read(image)


@dataclass(frozen=True)
class _Job:
    read: _Descriptors
    image: str
    vocabulary: Path
    run: tuple[object, ...]


def vlad_type(local_type: str) -> str:
    """The kapture type name of VLAD over a local type."""
    return f"vlad_{local_type}"


def train_on_map(
    mapping: KaptureFolder,
    local_type: str,
    options: VladOptions,
    *,
    work: Work = HERE,
) -> Vocabulary:
    """Train on the descriptors of the map's images.

    Raises
    ------
    DataError : they are missing, or too few.
    """
    images = mapping.read().image_names()
    descriptors = mapping.descriptors(local_type)
    if not any(descriptors.length(image) for image in images):
        raise DataError(f"the map has no descriptors of type {local_type}", path=mapping.root)
    read = _Descriptors(FolderSpec(mapping), local_type)
    each = partial(ordered_map, executor=work.executor)
    return train_vlad(images, descriptors.length, read, options, each=each)


def extract_vlad(
    mapping: KaptureFolder,
    folders: Sequence[KaptureFolder],
    local_type: str,
    output: Path,
    options: VladOptions,
    *,
    work: Work = HERE,
) -> dict[str, int]:
    """Train on ``mapping``, aggregate for all images of the folders, write to ``output``.

    The descriptors are read from the folders and their features folders.

    Returns
    -------
    Counts for the log: images, clusters, dimensions.
    """
    type_name = vlad_type(local_type)
    place = output / "global_features" / type_name
    described = mapping.descriptors(local_type)
    trained = work.items(
        f"vocabulary of {type_name}",
        [type_name],
        lambda _, digest: [
            [image, feature_inputs(described, image, digest)]
            for image in mapping.read().image_names()
        ],
    )
    if type_name not in trained.done:
        vocabulary = train_on_map(mapping, local_type, options, work=work)
        files = write_vocabulary(place, vocabulary, local_type, options)
        content = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
        said = [vocabulary.centres.shape[1], vocabulary.size, content]
        trained.add(type_name, files, said)
    num_centres, size, content = trained.done[type_name]
    config = FeatureConfig(type_name, np.dtype(np.float32), size, metric_type="L2")
    run = FolderSpec(mapping).key
    jobs, readers = [], {}
    for folder in folders:
        read, reader = _Descriptors(FolderSpec(folder), local_type), folder.descriptors(local_type)
        for image in folder.read().image_names():
            jobs.append(_Job(read, image, place, run))
            readers[image] = reader
    jobs.sort(key=lambda job: job.image)
    items = work.items(
        type_name,
        list(readers),
        lambda image, digest: [content, feature_inputs(readers[image], image, digest)],
    )
    todo = [job for job in jobs if job.image not in items.done]
    writer = FeatureWriter(output, "global_features", type_name, config, orphan=True)
    results = work.map(_aggregate, todo, items.label("VLAD"))
    for job, vector in zip(todo, results, strict=True):
        items.add(job.image, writer.write(job.image, vector))
    return {"images": len(jobs), "clusters": num_centres, "dimensions": size}


def _aggregate(job: _Job) -> NDArray[np.float32]:
    vocabulary, settings = _read_once(job.vocabulary, job.run)
    return aggregate(job.read(job.image), vocabulary, settings.options)


@lru_cache(maxsize=1)
def _read_once(folder: Path, run: tuple[object, ...]) -> tuple[Vocabulary, VladSettings]:
    """A vocabulary may be large: not sent with every image, but read once by every process."""
    found = read_vocabulary(folder)
    if found is None:
        raise DataError("the vocabulary is gone", path=folder / VOCABULARY_FILE)
    return found


def write_vocabulary(
    folder: Path, vocabulary: Vocabulary, local_type: str, options: VladOptions
) -> list[Path]:
    """Write what describes images into the folder of a global-features type; returns the files.

    ``vocabulary.npy`` and ``vlad.json``, and with whitening its mean and projection.
    """
    write_array(folder / VOCABULARY_FILE, vocabulary.centres)
    if vocabulary.whitening is not None:
        write_array(folder / MEAN_FILE, vocabulary.whitening.mean)
        write_array(folder / PROJECTION_FILE, vocabulary.whitening.projection)
    write_json_model(folder / SETTINGS_FILE, VladSettings(local_type=local_type, options=options))
    whitening = () if vocabulary.whitening is None else (MEAN_FILE, PROJECTION_FILE)
    return [folder / name for name in (VOCABULARY_FILE, *whitening, SETTINGS_FILE)]


def read_vocabulary(folder: Path) -> tuple[Vocabulary, VladSettings] | None:
    """The vocabulary stored in a type's folder, None where there is none.

    Raises
    ------
    DataError : a file is broken, or they do not fit each other.
    """
    path = folder / VOCABULARY_FILE
    if not path.is_file():
        return None
    settings = read_json_model(folder / SETTINGS_FILE, VladSettings)
    centres = _read_array(path, "vocabulary")
    if centres.ndim == 2:  # as it was written when there was one vocabulary only
        centres = centres[None]
    if centres.ndim != 3:
        raise DataError(f"not a vocabulary: {centres.shape}", path=path)
    if settings.options.dimensions is None:
        return Vocabulary(centres), settings
    mean = _read_array(folder / MEAN_FILE, "whitening")
    projection = _read_array(folder / PROJECTION_FILE, "whitening")
    if mean.shape != (centres.size,) or projection.shape[1:] != mean.shape:
        raise DataError(
            f"mean {mean.shape} and projection {projection.shape} do not fit the vocabulary "
            f"{centres.shape}",
            path=folder / PROJECTION_FILE,
        )
    return Vocabulary(centres, PcaWhitening(mean, projection)), settings


def _read_array(path: Path, what: str) -> NDArray[np.float32]:
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise DataError(f"not a {what}: {error}", path=path) from error
    if array.dtype != np.float32 or not np.isfinite(array).all():
        raise DataError(f"not a {what}: {array.dtype} {array.shape}", path=path)
    return array
