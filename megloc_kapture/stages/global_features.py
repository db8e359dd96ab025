"""Stage: a vector of every image, of VLAD trained on the map or of an image network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from megloc_kapture.errors import DataError, OptionError, PluginError, suggestion
from megloc_kapture.features.image_bound import bounded_image
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.plugin_loading import load_plugin, plugin_names
from megloc_kapture.plugins import (
    GLOBAL_FEATURES as PLUGINS,
)
from megloc_kapture.plugins import GlobalFeatureExtractor, PluginChoice
from megloc_kapture.stages.devices import in_batches
from megloc_kapture.stages.global_vlad import extract_vlad, vlad_type
from megloc_kapture.stages.layout import FEATURES, GLOBAL_FEATURES, LOCAL_FEATURES
from megloc_kapture.stages.local_features import image_inputs, read_image_of
from megloc_kapture.stages.map_points import described_images
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Batched, Work
from megloc_kapture.values import Camera

VLAD = "vlad"
_SIZE = attrgetter("camera.width", "camera.height")


class VladChoiceOptions(VladOptions):
    """Options of the global features ``vlad``."""

    local_type: str | None = Field(
        default=None, description="local features to aggregate; none: the first of the run"
    )

    def of_vlad(self) -> VladOptions:
        """How the vocabulary is trained and used."""
        return VladOptions(**self.model_dump(exclude={"local_type"}))


class GlobalFeaturesChoice(PluginChoice):
    """Global features by name: ``vlad``, or a plugin; its options, and its weight in fusion."""

    name: str = VLAD
    weight: float = Field(default=1.0, gt=0, description="among the features that are fused")

    @property
    def is_vlad(self) -> bool:
        """Whether they are trained on the map's local features."""
        return self.name == VLAD

    def vlad_options(self) -> VladChoiceOptions:
        """The options of VLAD; raises OptionError."""
        try:
            return VladChoiceOptions(**self.options)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise OptionError(f"global features vlad: option {where}: {first['msg']}") from error

    def make(self) -> GlobalFeatureExtractor:
        """The extractor of an image network.

        Raises
        ------
        OptionError : there are no such global features.
        PluginError, MissingWeightsError : it cannot be loaded, or refuses its options.
        """
        known = plugin_names(PLUGINS)
        if self.name not in known:
            raise OptionError(
                f"unknown global features {self.name!r}; {suggestion(self.name, [VLAD, *known])}"
            )
        extractor: GlobalFeatureExtractor = load_plugin(PLUGINS, self.name, self.options)
        return extractor

    def type_name(self, main_local_type: str) -> str:
        """The kapture type name of the vectors; raises as :meth:`make` and :meth:`vlad_options`.

        Parameters
        ----------
        main_local_type : local features that VLAD takes where its options name none.
        """
        if self.is_vlad:
            return vlad_type(self.vlad_options().local_type or main_local_type)
        return self.make().name


@dataclass(frozen=True)
class _Job:
    extractor: GlobalFeatureExtractor
    image: str
    path: Path
    camera: Camera


def extract_global_features(
    folders: Sequence[KaptureFolder],
    extractor: GlobalFeatureExtractor,
    output: Path,
    *,
    work: Work = HERE,
) -> dict[str, int]:
    """Describe all images of the folders, into ``output`` (orphan layout).

    Returns
    -------
    Counts for the log: images.

    Raises
    ------
    DataError : an image is absent, unreadable, or not of its camera's size; two folders have an
        image of the same name; there are no images.
    PluginError : the extractor breaks its protocol.
    """
    folder_of = _images(folders)
    items = work.items(
        extractor.name,
        list(folder_of),
        lambda image, digest: image_inputs(folder_of[image], image, digest)[:3],
    )
    jobs = [
        _Job(extractor, image, folder.image_path(image), folder.read().camera_of(image))
        for image, folder in folder_of.items()
        if image not in items.done
    ]
    jobs.sort(key=_SIZE)  # images of one size can be a batch
    steps: Batched[_Job, NDArray[np.float32]] = Batched(
        _read, _describe, extractor, "describe_many", _SIZE
    )
    writer: FeatureWriter | None = None
    size = 0
    for job, vector in zip(jobs, work.map(steps, jobs, items.label(extractor.name)), strict=True):
        if writer is None:
            size = len(vector)
            config = FeatureConfig(extractor.name, np.dtype(np.float32), size, metric_type="L2")
            writer = FeatureWriter(output, "global_features", extractor.name, config, orphan=True)
        if len(vector) != size:
            raise PluginError(
                f"plugin {extractor.name!r} on image {job.image}: {len(vector)} "
                f"values, {size} of the images before"
            )
        items.add(job.image, writer.write(job.image, vector))
    return {"images": len(items.done)}


def describe_images(
    extractor: GlobalFeatureExtractor, images: Sequence[NDArray[np.uint8]], names: Sequence[str]
) -> NDArray[np.float32]:
    """Vectors of RGB images of one size: float32 (B, D), unit length.

    Images of more than 8 megapixels are reduced to that, whatever the extractor.

    Parameters
    ----------
    names : of the images, for messages.

    Raises
    ------
    PluginError : the extractor returns something else.
    DeviceMemoryError : there is no memory for one image.
    """
    many: Any = extractor

    def describe(batch: Sequence[NDArray[np.uint8]]) -> list[Any]:
        found = many.describe_many(batch) if len(batch) > 1 else [extractor.describe(batch[0])]
        return list(_checked(extractor, found, len(batch), names[0]))

    bounded = [bounded_image(image) for image in images]
    return np.stack(
        in_batches(
            extractor,
            "describe_many",
            describe,
            bounded,
            size=lambda image: image.size,
            name=lambda k: f"image {names[k]}",
        )
    )


def _checked(
    extractor: GlobalFeatureExtractor, found: Any, count: int, label: str
) -> NDArray[np.float32]:
    def refuse(what: str) -> PluginError:
        return PluginError(f"plugin {extractor.name!r} on image {label}: {what}")

    for vector in found:
        if not isinstance(vector, np.ndarray) or vector.dtype != np.float32 or vector.ndim != 1:
            what = getattr(vector, "shape", type(vector).__name__)
            raise refuse(f"describe returned {what}, not float32 (D,)")
    if len({len(vector) for vector in found}) != 1 or len(found) != count:
        raise refuse(f"{len(found)} vectors for {count} images, or of different lengths")
    vectors = np.stack(found)
    if not np.isfinite(vectors).all():
        raise refuse("values that are not finite")
    norms = np.linalg.norm(vectors, axis=1)
    if np.abs(norms - 1.0).max() > 1e-3:
        raise refuse(f"a vector of length {norms[np.abs(norms - 1.0).argmax()]:.4g}, not 1")
    return vectors


def _images(folders: Sequence[KaptureFolder]) -> dict[str, KaptureFolder]:
    """All images in order of their names, with their folders."""
    named = sorted(
        ((image, folder) for folder in folders for image in folder.read().image_names()),
        key=lambda item: item[0],
    )
    for before, after in zip(named, named[1:], strict=False):
        if before[0] == after[0]:
            raise DataError(f"image {before[0]} stands in two kapture folders at once")
    if not named:
        raise DataError("there are no images to describe")
    return dict(named)


def _read(job: _Job) -> NDArray[np.uint8]:
    return read_image_of(job.path, job.camera)


def _describe(jobs: Sequence[_Job], images: Sequence[NDArray[np.uint8]]) -> Sequence[Any]:
    return list(describe_images(jobs[0].extractor, images, [job.image for job in jobs]))


class ExtractGlobalFeatures(PipelineStage):
    """Describe every image by the vectors that retrieval compares."""

    name = "global_features"
    version = 2
    uses = ("global_features.name", "global_features.options", *LOCAL_TYPES)
    writes = (GLOBAL_FEATURES,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        images = (self.layout.mapping, self.layout.query)
        return (*images, *self.layout.reference, LOCAL_FEATURES) if self._trains() else images

    def _trains(self) -> bool:
        return any(chosen.is_vlad for chosen in self.options.global_features)

    def settings(self) -> dict[str, Any]:
        found = super().settings()
        if self._trains():
            return found
        # image networks know nothing of local features
        return {key: found[key] for key in ("global_features", "weights") if key in found}

    def plugins(self) -> Sequence[object]:
        return [chosen.make() for chosen in self.options.global_features if not chosen.is_vlad]

    def run(self, work: StageWork) -> Mapping[str, float]:
        queries = work.folders((self.layout.query,), FEATURES)
        counts = {}
        for chosen in self.options.global_features:
            if chosen.is_vlad:
                vlad = chosen.vlad_options()
                local_type = vlad.local_type or self.options.main_type()
                mapping = described_images(work, self, local_type)
                found = extract_vlad(
                    mapping, [mapping, *queries], local_type, work.out, vlad.of_vlad(), work=work
                )
            else:
                folders = [work.folder(self.layout.mapping), *queries]
                found = extract_global_features(folders, chosen.make(), work.out, work=work)
            counts[chosen.name] = found["images"]
        return counts
