"""Challenge datasets in kapture folders, made of their official layouts by kapture's importers."""

from __future__ import annotations

from pathlib import Path

import kapture
import numpy as np
from kapture.converter.colmap.import_colmap import import_colmap
from kapture.io.csv import kapture_from_dir, kapture_to_dir
from kapture.io.records import TransferAction
from tools.kapture_import_image_list import import_image_list
from tools.kapture_import_RobotCar_Seasons import import_robotcar_seasons

from megloc_kapture.datasets.official import OfficialDataset, write_official
from megloc_kapture.io.kapture import KaptureData, KaptureFolder

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


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


def robotcar_with_kapture(official: Path, place: Path) -> Path:
    """Import RobotCar as kapture's guide says; the importer assumes images of 1024x1024 pixels."""
    import_robotcar_seasons(
        str(official), str(place), False, TransferAction.link_absolute, skip_reconstruction=True
    )
    for part in place.glob("*/*"):
        data = kapture_from_dir(str(part))
        for name, camera in data.sensors.items():
            data.sensors[name] = kapture.Camera(
                camera.camera_type, [8, 6, *camera.camera_params[2:]]
            )
        kapture_to_dir(str(part), data)
    return place


def without_images(folder: Path, gone: str) -> None:
    data = kapture_from_dir(str(folder))
    for time, sensor, name in list(kapture.flatten(data.records_camera)):
        if gone in name:
            del data.records_camera[time][sensor]
    kapture_to_dir(str(folder), data)


def assert_same_images(result: KaptureData, expected: KaptureData, *, atol: float = 0.0) -> None:
    """Compare images, their order, cameras and poses; ids of sensors may differ."""
    assert list(result.records_camera.values()) == list(expected.records_camera.values())
    for name in expected.records_camera.values():
        assert result.camera_of(name) == expected.camera_of(name)
        pose, actual_pose = expected.cam_from_world(name), result.cam_from_world(name)
        assert (actual_pose is None) == (pose is None), name
        if actual_pose is not None and pose is not None:
            np.testing.assert_allclose(actual_pose.matrix(), pose.matrix(), rtol=0, atol=atol)


def assert_same_dataset(
    result: OfficialDataset, expected: OfficialDataset, *, atol: float = 0.0
) -> None:
    """Compare images, tables, order of names and lines of the summary."""
    assert_same_images(result.mapping, expected.mapping, atol=atol)
    assert_same_images(result.query, expected.query, atol=atol)
    assert (result.query_gt is None) == (expected.query_gt is None)
    if result.query_gt is not None and expected.query_gt is not None:
        assert_same_images(result.query_gt, expected.query_gt, atol=atol)
    for table in ("groups", "priors", "protocol", "world", "names"):
        assert getattr(result, table) == getattr(expected, table), table
    assert list(result.names) == list(expected.names)
    assert list(map(str, result.summary)) == list(map(str, expected.summary))


def assert_linked(dataset: OfficialDataset, output: Path, images: Path) -> None:
    write_official(dataset, output)
    for part in ("mapping", "query"):
        folder = KaptureFolder(output / part)
        records = folder.root / "sensors" / "records_data"
        names = folder.read().image_names()
        files = [path for path in records.rglob("*") if not path.is_dir()]
        assert sorted(str(path.relative_to(records)) for path in files) == names
        assert all((records / name).samefile(images / name) for name in names)
