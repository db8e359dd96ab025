"""High-level API: open or build a map, localize in it, run a benchmark, evaluate.

>>> import megloc_kapture as megloc
>>> m = megloc.open_map("shared_map")                                         # doctest: +SKIP
>>> pose = m.localize("photo.jpg")                                            # doctest: +SKIP
>>> m.localize("query_kapture/", refine="icp").save("localized")              # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.kapture_folders import fitted_camera, warn_of_scaled
from megloc_kapture.errors import DataError, OptionError, suggestion
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.report.reports import REPORT_HTML
from megloc_kapture.io.colmap_mapping import Mapper
from megloc_kapture.io.dataset_tables import SIDE_TABLES
from megloc_kapture.io.images import (
    VIDEO_SUFFIXES,
    Photo,
    guessed_camera,
    image_size,
    photo_of,
    pillow_pixels,
    read_image_rgb,
    read_photo,
    turned_upright,
)
from megloc_kapture.io.kapture import KaptureFolder, is_kapture
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, absolute_pose
from megloc_kapture.pipeline.evaluation_plan import choose_run, plan_evaluation, recall_rows
from megloc_kapture.pipeline.executors import ExecutorKind, open_executor, single_threaded
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.map_making import (
    kapture_of,
    options_of_photographs,
    plan_map,
    plan_photographs,
)
from megloc_kapture.pipeline.plan import Workspace, run_plan
from megloc_kapture.pipeline.presets import options_of_preset, options_with
from megloc_kapture.pipeline.queries import Query, check_image
from megloc_kapture.pipeline.query_folders import Photographs
from megloc_kapture.pipeline.results import Results
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS
from megloc_kapture.stages.local_features import extract_all
from megloc_kapture.stages.matches import match_all
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.paths import EVALUATION, LOCALIZED, MAP
from megloc_kapture.stages.stage import Stage
from megloc_kapture.stages.work import Work
from megloc_kapture.values import (
    Camera,
    Failure,
    ImageFeatures,
    PixelOriginChoice,
    Pose,
    check_camera,
)

if TYPE_CHECKING:
    import pandas as pd
    from PIL import Image


Changes = Mapping[str, Any]
# not Sequence, which includes str
Files = list[str] | list[Path] | tuple[Path | str, ...]


def _as_tuple(given: Any) -> tuple[Any, ...]:
    single = isinstance(given, str | Path) or not isinstance(given, Iterable)
    return (given,) if single else tuple(given)


class Map:
    """A kapture map with its localization options. The map is read-only.

    Attributes
    ----------
    kapture_map : images, points and keypoint types of the map.
    options : localization options; other options have no effect.
    """

    def __init__(self, kapture_map: KaptureMap, options: PipelineOptions) -> None:
        self.kapture_map, self.options = kapture_map, options
        self._localizers: dict[tuple[str, ...], Localizer] = {}

    def __repr__(self) -> str:
        root, images = self.kapture_map.folder.root, self.kapture_map.images
        types = ", ".join(self.kapture_map.folder.types("keypoints"))
        return f"Map({str(root)!r}: {len(images)} images, features {types})"

    def localizer(self, refine: str | Sequence[str] = ()) -> Localizer:
        """Return the localizer that :meth:`localize` uses with these pose refiners; cached."""
        refiners = _as_tuple(refine or ())
        if refiners not in self._localizers:
            options = self.options
            if refiners:
                refined = options.pose_refinement.with_refiners(refiners)
                options = options.model_copy(update={"pose_refinement": refined})
            self._localizers[refiners] = Localizer(self.kapture_map, options=options)
        return self._localizers[refiners]

    def view(
        self,
        path: Path | str,
        result: Path | str | Results | None = None,
        truth: Path | str | None = None,
    ) -> None:
        """Write a 3D page of the map and a result; see
        :func:`megloc_kapture.evaluation.view.write_view`.
        """
        from megloc_kapture.evaluation.view import write_view

        if isinstance(result, Results):
            result.view(path, truth)
        else:
            write_view(path, self.kapture_map.folder, result, truth)

    @overload
    def localize(
        self,
        query: NDArray[np.uint8] | Image.Image,
        camera: Camera | None = None,
        *,
        prior: Sequence[str] | None = None,
        refine: str | Sequence[str] = (),
    ) -> Pose | Failure: ...

    @overload
    def localize(
        self,
        query: KaptureFolder | Files,
        camera: Camera | None = None,
        *,
        refine: str | Sequence[str] = (),
        workers: int = 1,
    ) -> Results: ...

    @overload
    def localize(
        self,
        query: Path | str,
        camera: Camera | None = None,
        *,
        prior: Sequence[str] | None = None,
        refine: str | Sequence[str] = (),
        workers: int = 1,
    ) -> Any: ...

    def localize(
        self,
        query: KaptureFolder | Files | Path | str | NDArray[np.uint8] | Image.Image,
        camera: Camera | None = None,
        *,
        prior: Sequence[str] | None = None,
        refine: str | Sequence[str] = (),
        workers: int = 1,
    ) -> Pose | Failure | Results:
        """Localize one image, or all images of a list, folder or video.

        For a single image, return a Pose, or a Failure, which is falsy and has a reason. Otherwise
        return :class:`Results`, a lazy mapping from image name to Pose or Failure.

        Parameters
        ----------
        query : image file; uint8 (H, W, 3) RGB; a pillow image; a video; a list of image files; a
            kapture folder, or a folder of plain images.
        camera : intrinsics of the image as stored, with COLMAP's models and pixel origin. Without
            a camera, an image is rotated upright by its EXIF orientation, and its focal length is
            initialised from EXIF or a guess and estimated with the pose, see ``Pose.camera``.
        prior : names of the map images to match with the query, which must be a single image.
        refine : names of pose refiners, applied in order: icp, rendering, field.
        workers : threads, for several images.
        """
        if isinstance(query, str):
            query = Path(query)
        if isinstance(query, Path) and is_kapture(query):
            query = KaptureFolder(query)
        localizer = self.localizer(refine)
        many: KaptureFolder | Photographs
        if isinstance(query, KaptureFolder):
            if camera is not None:
                raise OptionError(f"{query.root}: a kapture folder has its own cameras")
            many = query
        elif isinstance(query, list | tuple):
            many = Photographs(query, camera)
        elif isinstance(query, Path) and (query.is_dir() or query.suffix.lower() in VIDEO_SUFFIXES):
            many = Photographs([query], camera)
        else:
            return localizer.localize_query(_query_of(query, camera, prior))
        if prior is not None:
            raise OptionError(
                "prior is for one image; a kapture folder has its priors in megloc/priors.csv"
            )
        return Results(localizer, many, workers=workers)


def _query_of(
    image: Path | NDArray[np.uint8] | Image.Image,
    camera: Camera | None,
    prior: Sequence[str] | None,
) -> Query:
    check_image(image)
    name = image.name if isinstance(image, Path) else "query"  # its name in a list or a folder
    if camera is not None:
        check_camera(camera)
        if isinstance(image, np.ndarray):
            size = image.shape[1], image.shape[0]
        else:
            size = image_size(image) if isinstance(image, Path) else image.size
        photo = Photo(fitted_camera(camera, size))
        place = image if isinstance(image, Path) else Path(name)
        warn_of_scaled(place, [(camera, photo.camera)] if camera != photo.camera else [])
    elif isinstance(image, np.ndarray):
        photo = Photo(guessed_camera(image.shape[1], image.shape[0]))
    else:
        photo = read_photo(image) if isinstance(image, Path) else photo_of(image)
    if not isinstance(image, Path | np.ndarray):
        image = turned_upright(pillow_pixels(image), photo.orientation)
    return Query(photo.upright_camera, image, name, prior=prior, orientation=photo.orientation)


def open_map(
    path: Path | str,
    preset: str = "classic",
    *,
    set: Changes | None = None,
    features_dirs: Sequence[Path | str] | Path | str = (),
    pixel_origin: PixelOriginChoice = "auto",
) -> Map:
    """Open a map from this package or another tool, with all keypoint types that have 3D points.

    Parameters
    ----------
    path : kapture map, or a COLMAP model or workspace, which is imported into the user's cache if
        it is new or has changed (:func:`megloc_kapture.pipeline.map_making.kapture_of`).
    preset, set : localization options, ``set`` as ``{"localization.rank.name": "perceptual"}``.
    features_dirs : additional folder or folders with features.
    pixel_origin : pixel origin of the map's intrinsics; auto detects it.
    """
    options = options_of_preset(preset, assignments=set or {})
    opened = KaptureMap.open(
        kapture_of(path), features_dirs=features_dirs, pixel_origin=pixel_origin
    )
    if fault := opened.fault():
        raise DataError(f"{fault}; the poses would be wrong", path=Path(path))
    return Map(opened, options)


def _run(
    stages: Sequence[Stage], folder: Path | str, workers: int, scheduler: str | None
) -> Workspace:
    workspace = Workspace(Path(folder))
    kind: ExecutorKind = "processes" if scheduler is None else "dask"
    with (
        workspace.lock(),
        single_threaded(),
        open_executor(kind, workers, scheduler, workspace.root) as executor,
    ):
        run_plan(stages, workspace, Work(executor, num_threads=workers))
    return workspace


def build_map(
    mapping: Path | str,
    preset: str = "classic",
    *,
    set: Changes | None = None,
    workspace: Path | str | None = None,
    workers: int = 1,
    scheduler: str | None = None,
) -> Map:
    """Build a map from images with poses: features, pairs, matches, points, refinement.

    Parameters
    ----------
    mapping : kapture folder with images and poses; it is not changed.
    workspace : folder of all results, ``runs/MAPPING-PRESET`` by default. Up-to-date results in it
        are reused. Its folder ``map`` is the map.
    workers : processes; more than one needs ``if __name__ == "__main__":`` in a script.
    scheduler : address of a dask scheduler, whose workers are used instead.
    """
    source = KaptureFolder(mapping)
    options = options_of_preset(preset, assignments=set or {})
    place = workspace or Path("runs") / f"{source.root.resolve().name}-{preset}"
    made = _run(plan_map(source, options), place, workers, scheduler)
    return Map(KaptureMap.open(made.path(MAP)), options)


def map_photographs(
    images: Path | str | Sequence[Path | str],
    preset: str = "classic",
    *,
    set: Changes | None = None,
    camera: Camera | None = None,
    scale: tuple[str, str, float] | Literal["gps"] | None = None,
    mapper: Mapper = "incremental",
    workspace: Path | str | None = None,
    workers: int = 1,
    scheduler: str | None = None,
) -> Map:
    """Make a map from photographs without poses; see :mod:`megloc_kapture.pipeline.map_making`.

    Parameters
    ----------
    images : photographs, videos, or folders of them.
    camera : camera of all images, for the pixels as stored; without it, focal lengths are
        estimated with the poses.
    scale : ``"gps"`` for EXIF positions, or the names of two photographs and the distance between
        their cameras in metres. Without it the map is not metric, see ``map.kapture_map.unit``.
    mapper : COLMAP's mapper: incremental or global.
    workspace : ``runs/IMAGES-PRESET`` by default; ``megloc/unregistered.csv`` in it lists the
        photographs that are missing from the map.
    workers, scheduler : as in :func:`build_map`.
    """
    paths = _as_tuple(images)
    options = options_of_photographs(preset, set or {})
    photographs = Photographs(paths, camera)
    asked = () if scale is None else tuple(map(str, _as_tuple(scale)))
    title = Path(paths[0]).resolve().name
    place = workspace or Path("runs") / f"{title}-{preset}"
    stages = plan_photographs(photographs, options, mapper, asked)
    made = _run(stages, place, workers, scheduler)
    return Map(KaptureMap.open(made.path(MAP)), options)


@dataclass(frozen=True)
class FinishedRun:
    """A run of ``megloc eval`` and its results.

    Attributes
    ----------
    pose_file : the file to submit, or a folder if several files are to be submitted.
    """

    workspace: Path
    pose_file: Path
    options: PipelineOptions

    @cached_property
    def map(self) -> Map:
        """The map, with the options of the run."""
        return Map(KaptureMap.open(self.workspace / MAP), self.options)

    @property
    def localized(self) -> Path:
        """Kapture folder of the localized queries, with ``status.csv``."""
        return self.workspace / LOCALIZED

    @property
    def report(self) -> Path:
        """Path of the report, an HTML page."""
        return self.workspace / EVALUATION / REPORT_HTML

    @cached_property
    def recall(self) -> pd.DataFrame:
        """Recall by condition (rows) and threshold (columns); empty without ground truth."""
        import pandas as pd

        table = {
            name: {str(Threshold(**at["threshold"])): at["recall"] for at in row["recall"]}
            for name, row in recall_rows(self.workspace).items()
        }
        return pd.DataFrame.from_dict(table, orient="index")


def run(
    dataset: str,
    root: Path | str | None = None,
    *,
    preset: str | None = None,
    set: Changes | None = None,
    workspace: Path | str | None = None,
    workers: int = 1,
    scheduler: str | None = None,
) -> FinishedRun:
    """Run a benchmark as ``megloc eval`` does; up-to-date results are reused.

    Parameters
    ----------
    root : the dataset as published; by default, it is looked for below MEGLOC_DATA.
    preset : by default the preset in the dataset's benchmark file.
    workspace : ``runs/DATASET-PRESET`` by default, and ``runs/kapture-ROOT-PRESET`` for kapture
        folders.
    set, workers, scheduler : as in :func:`open_map` and :func:`build_map`.
    """
    chosen = choose_run(
        dataset, None if root is None else Path(root), preset=preset, assignments=set or {}
    )
    place = workspace or chosen.default_workspace
    made = _run(plan_evaluation(chosen), place, workers, scheduler)
    pose_file = chosen.submission_below(made.root, made.path(SIDE_TABLES))
    return FinishedRun(made.root, pose_file, chosen.options)


def extract(
    features: str, image: Path | str | NDArray[np.uint8] | Image.Image, **options: Any
) -> ImageFeatures:
    """Extract local features of an image with a named extractor.

    ``image`` is one image as in :meth:`Map.localize`, but never rotated; ``options`` are the
    extractor's. Raises PluginError or MissingWeightsError if the extractor cannot be loaded.
    """
    check_image(image)
    name = "given"
    if isinstance(image, str | Path):
        name, image = str(image), read_image_rgb(image)
    pixels = image if isinstance(image, np.ndarray) else pillow_pixels(image)
    extractor = load_plugin(LOCAL_FEATURES, features, options)
    extracted = extract_all(extractor, [(pixels, None)], [name])[0]
    height, width = pixels.shape[:2]
    return ImageFeatures(extracted.keypoints_px, extracted.descriptors, width, height)


def match(
    matcher: str, first: ImageFeatures, second: ImageFeatures, **options: Any
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Match two images with a named matcher; return keypoint rows, int64 (K, 2), and scores (K,).

    Raises PluginError or MissingWeightsError if the matcher cannot be loaded.
    """
    return match_all(load_plugin(MATCHERS, matcher, options), first, [second], ["the images"])[0]


def solve_pose(
    points_px: NDArray[Any],
    points_world: NDArray[Any],
    camera: Camera,
    *,
    max_error_px: float = 12.0,
    min_inliers: int = 12,
    seed: int = 0,
) -> Pose | Failure:
    """Estimate one image's pose from 2D-3D matches: LO-RANSAC, then refinement with covariance.

    Parameters
    ----------
    points_px : (N, 2), the first pixel's centre at (0.5, 0.5).
    points_world : (N, 3).
    max_error_px : inlier threshold of the reprojection error.
    """
    check_camera(camera)
    limits = {"max_error_px": max_error_px, "min_inliers": min_inliers, "seed": seed}
    options = options_with(AbsolutePoseOptions, limits)
    try:
        pixels = np.asarray(points_px, np.float64).reshape(len(points_px), 2)
        points = np.asarray(points_world, np.float64).reshape(len(pixels), 3)
    except (TypeError, ValueError) as error:
        raise DataError(
            "expected points_px (N, 2) and points_world (N, 3), got "
            f"{np.shape(points_px)} and {np.shape(points_world)}"
        ) from error
    return absolute_pose(pixels, points, camera, options)


def train(
    task: str,
    output: Path | str,
    *,
    kaptures: Sequence[Path | str] | Path | str = (),
    photographs: Sequence[Path | str] | Path | str = (),
    held_out: Sequence[Path | str] | Path | str = (),
    features: str = "superpoint",
    set: Mapping[str, Any] | None = None,
    threads: int = 1,
    force: bool = False,
) -> dict[str, float]:
    """Train SuperGlue or descriptors as ``megloc train`` does; an interrupted run is resumed.

    Return the last values of the training curves, by name.

    Parameters
    ----------
    task : "matcher" or "descriptor".
    output : ``X.safetensors``; for further files see :func:`megloc_kapture.training.train.train`.
    kaptures, held_out : kapture folders with poses and depth, for training and for evaluation.
    photographs : folders of images, for training with random homographies.
    features : name of the extractor whose features are matched, or whose detector is frozen.
    set : options, such as ``{"steps": 20000}``.
    """
    from megloc_kapture.training.train import TASKS
    from megloc_kapture.training.train import train as run_training

    if task not in TASKS:
        raise OptionError(f"unknown task {task!r}; {suggestion(task, TASKS)}")
    options = options_with(TASKS[task], set or {}, {"features.name": features})
    return run_training(
        options,
        Path(output),
        kaptures=[KaptureFolder(path) for path in _as_tuple(kaptures)],
        photographs=[Path(path) for path in _as_tuple(photographs)],
        held_out=[KaptureFolder(path) for path in _as_tuple(held_out)],
        force=force,
        threads=threads,
    )
