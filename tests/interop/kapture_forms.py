"""Challenge datasets in kapture folders, made of their official layouts by kapture's importers."""

from __future__ import annotations

from pathlib import Path

import kapture
from kapture.converter.colmap.import_colmap import import_colmap
from kapture.io.csv import kapture_from_dir, kapture_to_dir
from kapture.io.records import TransferAction
from tools.kapture_import_4seasons import import_4seasons_sequence
from tools.kapture_import_image_list import import_image_list
from tools.kapture_import_RobotCar_Seasons import import_robotcar_seasons

import megloc_kapture  # noqa: F401  before pycolmap, see megloc_kapture/io/colmap.py

import pycolmap  # isort: skip


def aachen_with_kapture(official: Path, place: Path) -> Path:
    """Import Aachen v1.1 as kapture's guide says: doc/datasets.adoc, "Aachen-Day-Night-v1.1"."""
    text = place.parent / f"{place.name}-text"
    text.mkdir(parents=True)
    pycolmap.Reconstruction(official / "3D-models" / "aachen_v_1_1").write_text(text)
    images, mapping = str(official / "images_upright"), str(place / "mapping")
    data = import_colmap(
        mapping,
        colmap_reconstruction_dir_path=str(text),
        colmap_images_dir_path=images,
        skip_reconstruction=True,
        images_import_strategy=TransferAction.link_absolute,
    )
    kapture_to_dir(mapping, data)
    for when in ("day", "night"):
        listed = official / "queries" / f"{when}_time_queries_with_intrinsics.txt"
        part = str(place / f"query_{when}")
        import_image_list([str(listed)], images, part, False, TransferAction.link_absolute)
    return place


def robotcar_with_kapture(official: Path, place: Path, size_px: tuple[int, int]) -> Path:
    """Import RobotCar as kapture's guide says; ``size_px`` is that of the images.

    The importer takes every image to be 1024x1024, as the published ones are.
    """
    import_robotcar_seasons(
        str(official), str(place), False, TransferAction.link_absolute, skip_reconstruction=True
    )
    for part in place.glob("*/*"):
        data = kapture_from_dir(str(part))
        for name, camera in data.sensors.items():
            params = [*size_px, *camera.camera_params[2:]]
            data.sensors[name] = kapture.Camera(camera.camera_type, params)
        kapture_to_dir(str(part), data)
    return place


def fourseasons_with_kapture(official: Path, place: Path) -> Path:
    """Import every recording of 4Seasons, as kapture-localization's run_4seasons.sh does."""
    for recording in official.glob("recording_*"):
        import_4seasons_sequence(
            str(official / "calibration"),
            str(recording),
            str(place / "records" / recording.name),
            TransferAction.link_absolute,
            False,
        )
    return place
