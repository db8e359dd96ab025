"""Read-only kapture map from any tool, for the localizer."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError, check_option, require
from megloc_kapture.geometry.cameras import shift_principal_point
from megloc_kapture.io.dataset_tables import NO_TABLES, SideTables, read_tables_of
from megloc_kapture.io.kapture import FeatureReader, KaptureFolder
from megloc_kapture.io.weights import registry
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.mapping.map_check import Origin, PixelOrigin, find_pixel_origin, map_fault
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.plugin_loading import plugin_names
from megloc_kapture.plugins import LOCAL_FEATURES, PluginChoice
from megloc_kapture.stages.local_features import check_lengths
from megloc_kapture.stages.map_refinement import REPORT_FILE
from megloc_kapture.stages.scene import check_points, index_map, observed_keypoints, with_noise
from megloc_kapture.values import Camera, PixelOriginChoice, RigidTransform

_SAMPLED_IMAGES = 50
_NETWORKS = ("aliked", "aslfeat", "disk", "r2d2", "superpoint", "xfeat")
# extractor for SIFT descriptors of bytes (True) or floats (False)
_SIFT_OF = {True: "sift", False: "rootsift"}


@dataclass(frozen=True, eq=False)
class MapKeypoints:
    """Keypoints of one type in a map, in COLMAP's convention, and the points that they observe.

    ``index`` holds points and observations as arrays, empty if the type has no points. For stored
    features of queries, ``folder`` and ``name`` refer to the queries.
    """

    folder: KaptureFolder
    name: str
    index: MapIndex
    pixel_origin: PixelOrigin

    def __contains__(self, image: str) -> bool:
        return image in self.stored_keypoints

    def keypoints_px(self, image: str) -> NDArray[np.float32]:
        """Return keypoints float32 (N, 2 or more) of a map image."""
        keypoints = np.array(self.stored_keypoints.read(image), dtype=np.float32)
        keypoints[:, :2] += np.float32(self.pixel_origin.keypoints_shift_px)
        return keypoints

    def descriptors(self, image: str) -> NDArray[Any]:
        """Return the stored descriptors (N, D) of a map image."""
        return np.asarray(self.stored_descriptors.read(image))

    def without_descriptors(self, images: Iterable[str]) -> list[str]:
        """Return the images that have keypoints but no descriptors."""
        with_keypoints = [image for image in images if image in self.stored_keypoints]
        if self.name not in self.folder.types("descriptors"):
            return with_keypoints
        return [image for image in with_keypoints if image not in self.stored_descriptors]

    def extractor(self) -> PluginChoice | None:
        """Return the extractor plugin named by the type or its ``keypoints.txt``, or None."""
        names = [self.name, base_type(self.name)]
        if self.name in self.folder.types("keypoints"):
            names.append(self.stored_keypoints.config.name)
        choice = next((choice for name in names if (choice := _extractor_named(name))), None)
        has_descriptors = self.name in self.folder.types("descriptors")
        if choice is not None and choice.name in _SIFT_OF.values() and has_descriptors:
            # other tools also use the name SIFT; COLMAP's and OpenMVG's descriptors are bytes
            choice = PluginChoice(name=_SIFT_OF[self.stored_descriptors.config.dtype.kind == "u"])
        return choice

    # opening a reader lists folders or tar members, so readers are cached
    @cached_property
    def stored_keypoints(self) -> FeatureReader:
        return self.folder.keypoints(self.name)

    @cached_property
    def stored_descriptors(self) -> FeatureReader:
        return self.folder.descriptors(self.name)


@dataclass(frozen=True, eq=False)
class KaptureMap:
    """Read-only map with 3D points, observations and keypoints; see :meth:`open`.

    All coordinates are in COLMAP's convention. ``keypoints`` are the types used for localization.
    ``tables`` have the coordinate frames of map images and the priors of queries; they are empty
    unless the map or its parent folder has tables.
    """

    folder: KaptureFolder
    keypoints: Mapping[str, MapKeypoints]
    tables: SideTables = NO_TABLES

    @classmethod
    def open(
        cls,
        path: Path | str,
        *,
        keypoints_types: Sequence[str] | str = (),
        features_dirs: Sequence[Path | str] | Path | str = (),
        pixel_origin: PixelOriginChoice = "auto",
    ) -> KaptureMap:
        """Open a kapture map.

        Parameters
        ----------
        keypoints_types : type or types used for localization; by default all that have points.
        features_dirs : additional feature folders in the orphan layout.
        pixel_origin : origin of the map's intrinsics; "auto" estimates it (see ``.pixel_origin``).
        """
        check_option(
            pixel_origin in ("auto", "corner", "centre"),
            f"pixel_origin is {pixel_origin!r}; give auto, corner or centre",
        )
        dirs = [features_dirs] if isinstance(features_dirs, Path | str) else features_dirs
        # files are read when they are needed, perhaps after os.chdir
        absolute = [Path(each).absolute() for each in (path, *dirs)]
        folder = KaptureFolder(absolute[0], features_dirs=absolute[1:])
        for features_dir in folder.features_dirs:
            require(features_dir.is_dir(), "no such features folder", path=features_dir)
        data = folder.read()
        check_points(folder, "localize in")
        require(
            any(data.cam_from_world(image) is not None for image in data.image_names()),
            "no image of the map has a pose: sensors/records_camera.txt or trajectories.txt is "
            "missing, or their timestamps or sensors differ",
            path=folder.root,
        )
        types = [keypoints_types] if isinstance(keypoints_types, str) else keypoints_types
        indices = _read_indices(folder, types)
        origins = _find_origins(folder, indices)
        if pixel_origin != "auto":
            origins = {
                name: replace(origin, intrinsics=pixel_origin, reason="as requested")
                for name, origin in origins.items()
            }
        keypoints = {n: MapKeypoints(folder, n, indices[n], origins[n]) for n in indices}
        return cls(folder, keypoints, read_tables_of(folder.root))

    @property
    def pixel_origin(self) -> PixelOrigin:
        """Origin of the intrinsics, and of the first type's keypoints."""
        return next(iter(self.keypoints.values())).pixel_origin

    def keypoints_of(self, name: str) -> MapKeypoints:
        if name in self.keypoints:
            return self.keypoints[name]
        index = index_map(self.folder, name)
        origin = self.pixel_origin
        if _is_ours(self.folder, name):
            origin = replace(origin, keypoints="corner")
        return MapKeypoints(self.folder, name, index, origin)

    @property
    def unit(self) -> str:
        """Unit of points and poses: ``m``, or ``units`` if the scale is unknown."""
        return self.tables.world.unit

    @cached_property
    def poses(self) -> dict[str, RigidTransform]:
        """``cam_from_world`` of the map images that have keypoints."""
        return {
            image: pose
            for image, pose in self.folder.read().poses().items()
            if any(image in keypoints for keypoints in self.keypoints.values())
        }

    @cached_property
    def images(self) -> list[str]:
        """Sorted names of map images that can be matched."""
        return sorted(self.poses)

    def camera(self, image: str) -> Camera:
        """Return the camera of a map image in COLMAP's convention."""
        return self.to_colmap(self.folder.read().camera_of(image))

    def to_colmap(self, camera: Camera) -> Camera:
        """Convert a camera from the map's convention to COLMAP's."""
        shift = self.pixel_origin.intrinsics_shift_px
        return shift_principal_point(camera, shift) if shift else camera

    def has_images(self) -> bool:
        try:
            return all(self.folder.image_path(image).is_file() for image in self.images)
        except DataError:
            return False

    def check(self) -> None:
        """Check the sizes of all feature files used for localization, without reading the files."""
        for keypoints in self.keypoints.values():
            if keypoints.without_descriptors(self.images):
                continue
            for image in self.images:
                if image in keypoints:
                    check_lengths(keypoints.stored_keypoints, keypoints.stored_descriptors, image)
        for name in self.global_types:
            vectors = self.folder.global_features(name)
            for image in self.images:
                vectors.length(image)

    def fault(self) -> str | None:
        """Return the reason if the map contradicts itself in a sample of its images, or None."""
        for name, keypoints in self.keypoints.items():
            images = [image for image in self.images if image in keypoints]
            # runs of consecutive images, spread over the map
            run, number = 10, _SAMPLED_IMAGES // 10
            starts = np.linspace(0, max(len(images) - run, 0), number).astype(int).tolist()
            taken = sorted({at for start in starts for at in range(start, start + run)})
            # keep stored coordinates: an origin off by half a pixel is far below the tolerance
            sample = observed_keypoints(
                self.folder, keypoints.index, (images[at] for at in taken if at < len(images))
            )
            reason = map_fault(sample, keypoints.index.xyz)
            if reason is not None:
                return reason if len(self.keypoints) == 1 else f"{name}: {reason}"
        return None

    @cached_property
    def global_types(self) -> list[str]:
        """Global-feature types that all map images have."""
        readers = map(self.folder.global_features, self.folder.types("global_features"))
        return [
            reader.type_name for reader in readers if all(image in reader for image in self.images)
        ]


def plain_name(local_type: str) -> str:
    """Return a type's name in lower case without separators, which differ between tools."""
    return re.sub("[^a-z0-9]", "", local_type.lower())


def _extractor_named(name: str) -> PluginChoice | None:
    """Return the plugin with the type's name, or with weights of that name.

    A trailing number (r2d2_500) is ignored.
    """
    plugins = {plain_name(plugin): plugin for plugin in plugin_names(LOCAL_FEATURES)}
    weights = {plain_name(key): key for key in registry()}
    for plain in (plain_name(name), plain_name(re.sub(r"[-_ ]\d+k?$", "", name))):
        if plain in plugins:
            return PluginChoice(name=plugins[plain])
        plugin = next((plugins[key] for key in plugins if plain.startswith(key)), None)
        if plugin is not None and plain in weights:
            return PluginChoice(name=plugin, options={"weights": weights[plain]})
    return None


def _read_indices(folder: KaptureFolder, keypoints_types: Sequence[str]) -> dict[str, MapIndex]:
    present = sorted(t for t, seen in folder.observations().items() if len(seen.point_ids))
    require(present, "the map's points have no observations", path=folder.root)
    absent = [name for name in keypoints_types if name not in present]
    if absent:
        raise OptionError(
            f"{folder.root}: no points of keypoints type {absent[0]!r}; there are: "
            f"{', '.join(present)}"
        )
    types = sorted(set(keypoints_types)) or present
    return {name: with_noise(folder, index_map(folder, name)) for name in types}


def _is_ours(folder: KaptureFolder, local_type: str) -> bool:
    """Return whether the keypoints are certainly in megloc's convention.

    Other tools use the same type names, but may follow the convention of the network.
    """
    refined = (folder.root / "reconstruction" / REPORT_FILE).is_file()
    name = base_type(local_type)
    extractor = _extractor_named(name)
    if extractor is None or name not in (extractor.name, extractor.options.get("weights")):
        return False
    return refined or extractor.name not in _NETWORKS


def _find_origins(folder: KaptureFolder, indices: Mapping[str, MapIndex]) -> dict[str, PixelOrigin]:
    """Estimate the pixel origins of the intrinsics and of each type's keypoints.

    The origin of the intrinsics is estimated from the type with the most observations.
    """
    origin_of = {name: _find_origin(folder, name, index) for name, index in indices.items()}
    most = max(origin_of, key=lambda name: (len(indices[name].point_ids), name))
    intrinsics = origin_of[most].intrinsics
    origins = {}
    for name, origin in origin_of.items():
        if origin.intrinsics != intrinsics:
            # only the offset between keypoints and intrinsics is measured: equal origins stay equal
            agree = origin.keypoints == origin.intrinsics
            keypoints = intrinsics if agree else origin.keypoints
            reason = f"{origin.reason}; intrinsics from {most}: {intrinsics}"
            origin = replace(origin, intrinsics=intrinsics, keypoints=keypoints, reason=reason)
        origins[name] = origin
    return origins


def _find_origin(folder: KaptureFolder, local_type: str, index: MapIndex) -> PixelOrigin:
    data = folder.read()
    poses = data.poses()
    images = [image for image in sorted(index.row_of_image) if image in poses]
    keypoints = folder.keypoints(local_type)
    for image in images:
        require(
            image in keypoints,
            f"points are observed in {image!r}, which has no keypoints of type {local_type!r}",
            path=folder.root / "reconstruction" / "observations.txt",
        )
    step = max(1, len(images) // _SAMPLED_IMAGES)
    sample = observed_keypoints(folder, index, images[::step])
    known: Origin | None = "corner" if _is_ours(folder, local_type) else None
    return find_pixel_origin(
        sample, index.xyz, cameras=[data.camera_of(image) for image in images], keypoints_at=known
    )
