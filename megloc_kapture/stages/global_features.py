"""Stage: global features of every image, by VLAD trained on the map or by an image network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from megloc_kapture.errors import OptionError, PluginError, require, suggestion
from megloc_kapture.features.image_bound import bounded_image
from megloc_kapture.features.vlad import VladOptions, Vocabulary, aggregate, train_vlad
from megloc_kapture.io.files import read_json_model, write_json_model
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.io.kapture.features import has_features
from megloc_kapture.plugin_loading import (
    AUTO,
    NetworkOptions,
    checked_array,
    load_chosen,
    option_fault,
    plugin_names,
)
from megloc_kapture.plugins import GLOBAL_FEATURES, GlobalFeatureExtractor, PluginChoice
from megloc_kapture.stages import paths
from megloc_kapture.stages.local_features import Job, images_of, read_stored_image, size_of
from megloc_kapture.stages.map_features import (
    MEAN_FILE,
    PROJECTION_FILE,
    SETTINGS_FILE,
    VOCABULARY_FILE,
)
from megloc_kapture.stages.scene import write_array
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Batched, Work, in_batches, ordered_map
from megloc_kapture.values import Options


class VladSettings(Options):
    """``vlad.json``: settings of the stored VLAD vectors."""

    local_type: str
    options: VladOptions


def _descriptors(folder: KaptureFolder, local_type: str, image: str) -> NDArray[Any]:
    return folder.descriptors(local_type).read(image)


def vlad_type(local_type: str) -> str:
    return f"vlad_{local_type}"


def extract_vlad(
    mapping: KaptureFolder,
    folders: Sequence[KaptureFolder],
    local_type: str,
    output: Path,
    options: VladOptions,
    *,
    work: Work = HERE,
) -> int:
    """Train VLAD on ``mapping`` and write vectors of all images; return the number of images."""
    type_name = vlad_type(local_type)
    place = output / "global_features" / type_name
    if not work.resume or read_vocabulary(place) is None:
        images, descriptors = mapping.read().image_names(), mapping.descriptors(local_type)
        require(
            any(descriptors.length(image) for image in images),
            f"the map has no descriptors of type {local_type}",
            path=mapping.root,
        )
        read = partial(_descriptors, mapping, local_type)
        each = partial(ordered_map, executor=work.executor)
        vocabulary = train_vlad(images, descriptors.length, read, options, each=each)
        write_vocabulary(place, vocabulary, local_type, options)
    describe = partial(_aggregate, local_type, place)
    return _write_vectors(folders, type_name, output, describe, work, label="VLAD")


def _aggregate(local_type: str, place: Path, job: Job) -> NDArray[np.float32]:
    stored = read_vocabulary(place)
    assert stored is not None
    image, folder = job
    return aggregate(_descriptors(folder, local_type, image), stored[0])


def _write_vectors(
    folders: Sequence[KaptureFolder],
    type_name: str,
    output: Path,
    describe: Callable[[Job], NDArray[np.float32]] | Batched[Job, NDArray[np.float32]],
    work: Work,
    *,
    label: str,
) -> int:
    """Write vectors of all images (orphan layout); return the number of images."""
    folder_of = images_of(folders, "describe")
    is_written = partial(has_features, output, "global_features", type_name)
    images, label = work.unfinished(folder_of, is_written, label)
    jobs = [(image, folder_of[image]) for image in images]
    if isinstance(describe, Batched):  # images of equal size can share a batch
        jobs.sort(key=size_of)
    writer: FeatureWriter | None = None
    results = work.map(describe, jobs, label)
    for (image, _), vector in zip(jobs, results, strict=True):
        if writer is None:
            kind = np.dtype(np.float32)
            config = FeatureConfig(type_name, kind, len(vector), metric_type="L2")
            writer = FeatureWriter(output, "global_features", type_name, config, orphan=True)
        writer.write(image, vector)
    return len(folder_of)


def write_vocabulary(
    folder: Path, vocabulary: Vocabulary, local_type: str, options: VladOptions
) -> None:
    """Write ``vocabulary.npy``, the whitening and, last, ``vlad.json``."""
    write_array(folder / VOCABULARY_FILE, vocabulary.centres)
    for name, array in ((MEAN_FILE, vocabulary.mean), (PROJECTION_FILE, vocabulary.projection)):
        if array is not None:
            write_array(folder / name, array)
    write_json_model(folder / SETTINGS_FILE, VladSettings(local_type=local_type, options=options))


def read_vocabulary(folder: Path) -> tuple[Vocabulary, VladSettings] | None:
    """Read the vocabulary and the settings of a VLAD type; None if they are missing.

    The arrays are mapped into memory, where processes share them.
    """
    if not (folder / SETTINGS_FILE).is_file():
        return None
    settings = read_json_model(folder / SETTINGS_FILE, VladSettings)
    names = [VOCABULARY_FILE]
    if settings.options.dimensions is not None:
        names += [MEAN_FILE, PROJECTION_FILE]
    return Vocabulary(*(np.load(folder / name, mmap_mode="r") for name in names)), settings


VLAD = "vlad"


class GlobalFeaturesChoice(PluginChoice):
    """Global features by name (``vlad`` or a plugin), with options and fusion weight."""

    name: str = VLAD
    weight: float = Field(default=1.0, gt=0, description="weight in the fusion")

    @property
    def is_vlad(self) -> bool:
        return self.name == VLAD

    def vlad_options(self) -> VladOptions:
        try:
            return VladOptions(**self.options)
        except ValidationError as error:
            fault = option_fault(error, VladOptions)
            raise OptionError(f"global features {VLAD!r} reject their options: {fault}") from error

    def make(self, placement: NetworkOptions = AUTO) -> GlobalFeatureExtractor:
        known = plugin_names(GLOBAL_FEATURES)
        if self.name not in known:
            raise OptionError(
                f"unknown global features {self.name!r}; {suggestion(self.name, [VLAD, *known])}"
            )
        extractor: GlobalFeatureExtractor = load_chosen(GLOBAL_FEATURES, self, placement)
        return extractor

    def type_name(self, main_local_type: str) -> str:
        """Return the kapture type name; VLAD uses ``main_local_type`` by default."""
        if self.is_vlad:
            return vlad_type(self.vlad_options().local_type or main_local_type)
        return self.make().name


def extract_global_features(
    folders: Sequence[KaptureFolder],
    extractor: GlobalFeatureExtractor,
    output: Path,
    *,
    work: Work = HERE,
) -> int:
    """Write global features of all images (orphan layout); return the number of images."""
    describe = partial(_describe, extractor)
    steps: Batched[Job, NDArray[np.float32]] = Batched(
        _read, describe, extractor, "describe_many", size_of
    )
    return _write_vectors(folders, extractor.name, output, steps, work, label=extractor.name)


def describe_images(
    extractor: GlobalFeatureExtractor, images: Sequence[NDArray[np.uint8]], names: Sequence[str]
) -> NDArray[np.float32]:
    """Compute unit vectors, float32 (B, D), of RGB images of one size.

    Images with more than 8 megapixels are reduced first.
    """
    many: Any = extractor

    def describe(batch: Sequence[NDArray[np.uint8]]) -> list[Any]:
        vectors = many.describe_many(batch) if len(batch) > 1 else [extractor.describe(batch[0])]
        return _checked(extractor, vectors, names[0])

    bounded = [bounded_image(image) for image in images]
    return np.stack(
        in_batches(
            extractor,
            "describe_many",
            describe,
            bounded,
            name=lambda k: f"image {names[k]}",
        )
    )


def _checked(extractor: GlobalFeatureExtractor, described: Any, label: str) -> list[NDArray[Any]]:
    who = f"plugin {extractor.name!r} on image {label}"
    vectors = [checked_array(who, vector, (None,), "float32") for vector in described]
    for vector in vectors:
        length = float(np.linalg.norm(vector))
        if abs(length - 1.0) > 1e-3:
            raise PluginError(f"{who}: a vector of length {length:.4g}, expected 1")
    return vectors


def _read(job: Job) -> NDArray[np.uint8]:
    image, folder = job
    return read_stored_image(folder, image)


def _describe(
    extractor: GlobalFeatureExtractor, jobs: Sequence[Job], images: Sequence[NDArray[np.uint8]]
) -> Sequence[Any]:
    return list(describe_images(extractor, images, [image for image, _ in jobs]))


class ExtractGlobalFeatures(PipelineStage):
    """Extract global features of all images for retrieval."""

    name = "global_features"
    version = 3
    resumes = True
    uses = ("global_features.name", "global_features.options", *LOCAL_TYPES)
    explained_by = ("global_features",)
    outputs = (paths.GLOBAL_FEATURES,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        images = (self.mapping(), self.query())
        return (*images, paths.LOCAL_FEATURES) if self._trains() else images

    def _trains(self) -> bool:
        return any(chosen.is_vlad for chosen in self.options.global_features)

    def settings(self) -> dict[str, Any]:
        settings = super().settings()
        if self._trains():
            return settings
        # image networks do not depend on local features
        keys = ("global_features", "weights", "precision")
        return {key: settings[key] for key in keys if key in settings}

    def plugins(self) -> Sequence[object]:
        return [chosen.make() for chosen in self.options.global_features if not chosen.is_vlad]

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping = work.folder(self.mapping(), paths.FEATURES)
        folders = [mapping, *work.folders((self.query(),), paths.FEATURES)]
        counts: dict[str, float] = {}
        for chosen in self.options.global_features:
            if chosen.is_vlad:
                vlad = chosen.vlad_options()
                name = vlad.local_type or self.options.main_type()
                number = extract_vlad(mapping, folders, name, work.out, vlad, work=work)
            else:
                extractor = chosen.make(work.placement)
                number = extract_global_features(folders, extractor, work.out, work=work)
            counts[f"images_with_{chosen.name}"] = number
        return counts
