"""A scene in COLMAP's form: images, a database of features, and a model."""

from __future__ import annotations

import os
from pathlib import Path

from megloc_kapture.io.kapture import KaptureFolder

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


def write_workspace(root: Path, scene: Path) -> None:
    """Write ``images/``, ``database.db`` and ``sparse/0`` of a scene's map, all of one camera.

    COLMAP extracts, matches and triangulates, with the true camera and poses: its model is in
    the scene's world.
    """
    mapping = KaptureFolder(scene / "mapping")
    data, names = mapping.read(), mapping.read().image_names()
    (root / "images").mkdir(parents=True)
    (root / "sparse" / "0").mkdir(parents=True)
    for name in names:
        os.symlink(mapping.image_path(name), root / "images" / name)
    known = data.camera_of(names[0])
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
    pycolmap.triangulate_points(posed, root / "database.db", root / "images", root / "sparse" / "0")
