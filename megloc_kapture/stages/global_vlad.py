"""Stage: VLAD of every image from its local descriptors, as a kapture global feature.

The vocabulary is trained on the map's descriptors and stored beside the vectors, so that queries
that come later get theirs from the same.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.vlad import (
    VladOptions,
    Vocabulary,
    aggregate,
    sample_rows,
    train_vocabulary,
)
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.json_model import read_json_model, write_json_model
from megloc_kapture.io.kapture_store import (
    FeatureConfig,
    FeatureReader,
    FeatureWriter,
    KaptureFolder,
)
from megloc_kapture.stages.parallel import FolderSpec, Track, ordered_map, untracked
from megloc_kapture.values import Options

VOCABULARY_FILE = "vocabulary.npy"
SETTINGS_FILE = "vlad.json"


class VladSettings(Options):
    """What ``vlad.json`` says: how the vectors beside it were made."""

    local_type: str
    options: VladOptions


@dataclass(frozen=True)
class _Job:
    folder: FolderSpec
    local_type: str
    image: str
    vocabulary: Vocabulary
    options: VladOptions


def vlad_type(local_type: str) -> str:
    """The kapture type name of VLAD over a local type."""
    return f"vlad_{local_type}"


def train_on_map(
    descriptors: FeatureReader, images: Sequence[str], options: VladOptions
) -> Vocabulary:
    """Train the vocabulary on the map images' descriptors, the same share of each image's."""
    counts = [descriptors.length(image) for image in images]
    rows = sample_rows(counts, options.training_descriptors, options.seed)
    sampled = [
        descriptors.read(image)[chosen]
        for image, chosen in zip(images, rows, strict=True)
        if len(chosen)
    ]
    if not sampled:
        raise DataError(f"the map has no descriptors of type {descriptors.type_name}")
    return train_vocabulary(np.concatenate(sampled), options)


def extract_vlad(
    mapping: KaptureFolder,
    folders: Sequence[KaptureFolder],
    local_type: str,
    output: Path,
    options: VladOptions,
    *,
    executor: Executor | None = None,
    track: Track = untracked,
) -> dict[str, int]:
    """Train on ``mapping``, aggregate for all images of the folders, write to ``output``.

    The descriptors are read from the folders and their features folders.
    """
    images = mapping.read().image_names()
    vocabulary = train_on_map(mapping.descriptors(local_type), images, options)
    type_name = vlad_type(local_type)
    write_vocabulary(output / "global_features" / type_name, vocabulary, local_type, options)
    config = FeatureConfig(
        type_name, np.dtype(np.float32), vocabulary.centres.size, metric_type="L2"
    )
    jobs = []
    for folder in folders:
        spec = FolderSpec(folder.root, folder.features_dirs)
        jobs += [
            _Job(spec, local_type, image, vocabulary, options)
            for image in folder.read().image_names()
        ]
    jobs.sort(key=lambda job: job.image)
    writer = FeatureWriter(output, "global_features", type_name, config, orphan=True)
    results = ordered_map(_aggregate, jobs, executor)
    for job, vector in zip(jobs, track(results, len(jobs), "VLAD"), strict=True):
        writer.write(job.image, vector)
    return {"images": len(jobs), "clusters": len(vocabulary.centres)}


def _aggregate(job: _Job) -> NDArray[np.float32]:
    descriptors = job.folder.open().descriptors(job.local_type).read(job.image)
    return aggregate(descriptors, job.vocabulary, job.options)


def write_vocabulary(
    folder: Path, vocabulary: Vocabulary, local_type: str, options: VladOptions
) -> None:
    """Write ``vocabulary.npy`` and ``vlad.json`` into the folder of a global-features type."""
    buffer = io.BytesIO()
    np.save(buffer, vocabulary.centres, allow_pickle=False)
    write_bytes(folder / VOCABULARY_FILE, buffer.getvalue())
    write_json_model(folder / SETTINGS_FILE, VladSettings(local_type=local_type, options=options))


def read_vocabulary(folder: Path) -> tuple[Vocabulary, VladSettings] | None:
    """The vocabulary stored in a type's folder, None where there is none.

    Raises
    ------
    DataError : the file is broken.
    """
    path = folder / VOCABULARY_FILE
    if not path.is_file():
        return None
    settings = read_json_model(folder / SETTINGS_FILE, VladSettings)
    try:
        centres = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise DataError(f"not a vocabulary: {error}", path=path) from error
    if centres.ndim != 2 or centres.dtype != np.float32 or not np.isfinite(centres).all():
        raise DataError(f"not a vocabulary: {centres.dtype} {centres.shape}", path=path)
    return Vocabulary(centres), settings
