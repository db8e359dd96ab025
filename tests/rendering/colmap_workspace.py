"""A scene in COLMAP's form: images, a database of features, and a model."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import MATCHERS, LocalFeatureExtractor
from megloc_kapture.values import ImageFeatures

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


def write_workspace(
    root: Path, scene: Path, *, extractor: LocalFeatureExtractor | None = None, kind: Any = None
) -> Any:
    """Write ``images/``, ``database.db`` and ``sparse/0`` of a scene's map, all of one camera.

    COLMAP extracts, matches and triangulates, with the true camera and poses: its model is in
    the scene's world.

    Parameters
    ----------
    extractor : features instead of COLMAP's SIFT, which its wheels cannot extract.
    kind : the pycolmap.FeatureExtractorType of these features.

    Returns
    -------
    The pycolmap.Reconstruction.
    """
    mapping = KaptureFolder(scene / "mapping")
    data, names = mapping.read(), mapping.read().image_names()
    (root / "images").mkdir(parents=True)
    (root / "sparse" / "0").mkdir(parents=True)
    for name in names:
        os.symlink(mapping.image_path(name), root / "images" / name)
    known = data.camera_of(names[0])
    if extractor is None:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = known.model
        reader.camera_params = ",".join(map(repr, known.params))
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads, options.sift.max_num_features = 1, 1000
        pycolmap.extract_features(
            root / "database.db",
            root / "images",
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
        )
        pycolmap.match_exhaustive(root / "database.db")
    else:
        _write_features(root, names, known, extractor, kind)
    posed = pycolmap.Reconstruction()
    database = pycolmap.Database.open(root / "database.db")
    for camera in database.read_all_cameras():
        posed.add_camera_with_trivial_rig(camera)
    for image in database.read_all_images():
        pose = data.cam_from_world(image.name)
        assert pose is not None
        keypoints = database.read_keypoints(image.image_id)
        w, x, y, z = pose.quat_wxyz
        posed.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name,
                image_id=image.image_id,
                camera_id=image.camera_id,
                keypoints=keypoints[:, :2].astype(float),
            ),
            pycolmap.Rigid3d(pycolmap.Rotation3d([x, y, z, w]), pose.translation),
        )
    database.close()
    return pycolmap.triangulate_points(
        posed, root / "database.db", root / "images", root / "sparse" / "0"
    )


def _write_features(
    root: Path, names: list[str], known: Any, extractor: LocalFeatureExtractor, kind: Any
) -> None:
    """Write features and mutual matches to the database, and let COLMAP verify the matches."""
    database = pycolmap.Database.open(root / "database.db")
    camera = pycolmap.Camera(
        model=known.model, width=known.width, height=known.height, params=known.params
    )
    camera_id = database.write_camera(camera)
    features, ids = {}, {}
    for name in names:
        result = extractor.extract(read_image_rgb(root / "images" / name))
        features[name] = ImageFeatures(
            result.keypoints_px, result.descriptors, known.width, known.height
        )
        ids[name] = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        affine = np.zeros((len(result.keypoints_px), 6), np.float32)
        affine[:, :2], affine[:, 2], affine[:, 5] = result.keypoints_px[:, :2], 1, 1
        database.write_keypoints(ids[name], affine)
        rows = np.ascontiguousarray(result.descriptors).view(np.uint8)
        database.write_descriptors(ids[name], pycolmap.FeatureDescriptors(kind, rows))
    pairs = list(itertools.combinations(names, 2))
    matcher = load_plugin(MATCHERS, "nn", {})
    for first, second in pairs:
        matches, _ = matcher.match(features[first], features[second])
        database.write_matches(ids[first], ids[second], matches.astype(np.uint32))
    database.close()
    (root / "pairs.txt").write_text("".join(f"{first} {second}\n" for first, second in pairs))
    pycolmap.verify_matches(root / "database.db", root / "pairs.txt")
