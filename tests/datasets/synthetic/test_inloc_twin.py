"""The twin of InLoc: what is written, and that its import gives its truth."""

from __future__ import annotations

import hashlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import scipy.io

import megloc_kapture  # noqa: F401  before kapture
from megloc_kapture.datasets.inloc.adapter import InLoc, InLocOptions
from megloc_kapture.datasets.official import write_official
from megloc_kapture.datasets.synthetic.inloc_twin import InLocTwinOptions, write_inloc_twin
from megloc_kapture.io.dataset_tables import read_groups
from megloc_kapture.io.images import read_depth_map, read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder

SMALL = InLocTwinOptions(
    modules=1,
    queries=5,
    cutout_width=64,
    cutout_height=48,
    query_width=96,
    query_height=72,
    supersampling=1,
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("inloc") / "InLoc"
    assert write_inloc_twin(root, SMALL) == {
        "floors": 2,
        "scans": 6,
        "mapping images": 216,
        "query images": 5,
    }
    return root


@pytest.fixture(scope="module")
def imported(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("imported")
    write_official(InLoc().read(root), output)
    return output


def test_the_layout_is_the_official_one(root: Path) -> None:
    names = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    for floor in ("DUC1", "DUC2"):
        for scan in ("000", "001", "002"):
            assert f"database/alignments/{floor}/transformations/DUC_trans_{scan}.txt" in names
            for yaw in range(0, 360, 30):
                for pitch in (-30, 0, 30):
                    cutout = f"database/cutouts/{floor}/{scan}/DUC_cutout_{scan}_{yaw}_{pitch}.jpg"
                    assert {cutout, f"{cutout}.mat"} <= names
    assert Counter(name.split("/")[0] for name in names) == {
        "database": 6 * (72 + 1),
        "query": 5,
        "ground_truth": 7,
    }
    assert {f"query/iphone7/IMG_080{n}.JPG" for n in range(1, 6)} <= names


def test_matlab_files_as_published(root: Path) -> None:
    path = root / "database/cutouts/DUC1/001/DUC_cutout_001_60_0.jpg"
    content = scipy.io.loadmat(f"{path}.mat")
    assert content["XYZcut"].dtype == np.float64
    assert content["XYZcut"].shape == content["RGBcut"].shape == (48, 64, 3)
    assert content["RGBcut"].dtype == np.uint8
    off = np.abs(content["RGBcut"].astype(int) - read_image_rgb(path))
    assert off.mean() < 6  # as JPEG has it


def test_the_import_gives_the_truth(root: Path, imported: Path) -> None:
    import kapture
    from kapture.io.csv import kapture_from_dir

    for part, truth in (("mapping", "mapping"), ("query_gt", "query")):
        theirs = kapture_from_dir(str(imported / part))
        poses = theirs.trajectories
        if theirs.rigs:
            poses = kapture.rigs_remove(poses, theirs.rigs)
        true = kapture_from_dir(str(root / "ground_truth" / truth))
        expected = {
            name: true.trajectories[timestamp, sensor]
            for timestamp, sensor, name in kapture.flatten(true.records_camera)
        }
        found = {
            name: poses[timestamp, sensor]
            for timestamp, sensor, name in kapture.flatten(theirs.records_camera)
        }
        assert found.keys() == expected.keys()
        assert len(found) == (216 if part == "mapping" else 5)
        for name, pose in found.items():
            between = kapture.PoseTransform.compose([pose, expected[name].inverse()])
            sine = np.linalg.norm([between.r.x, between.r.y, between.r.z])
            assert np.degrees(2 * np.arcsin(min(1.0, sine))) < 1e-6
            centers = [np.ravel(p.inverse().t) for p in (pose, expected[name])]
            assert np.linalg.norm(centers[0] - centers[1]) < 1e-6


def test_scanned_points_are_seen_in_their_pixels(root: Path, imported: Path) -> None:
    """From the file to the pixel by MATLAB's rules, scipy, numpy, kapture and COLMAP alone."""
    import kapture
    import pycolmap
    from kapture.io.csv import kapture_from_dir

    theirs = kapture_from_dir(str(imported / "mapping"))
    poses = kapture.rigs_remove(theirs.trajectories, theirs.rigs)
    depths = {t: name for t, _, name in kapture.flatten(theirs.records_depth)}
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    missing = []
    for timestamp, sensor, name in list(kapture.flatten(theirs.records_camera))[::5]:
        points = scipy.io.loadmat(root / f"{name}.mat")["XYZcut"]
        _, _, floor, scan, _ = name.split("/")
        lines = (
            (root / f"database/alignments/{floor}/transformations/DUC_trans_{scan}.txt")
            .read_text()
            .splitlines()
        )
        matrix = np.array([line.split() for line in lines[7:11]], np.float64)
        seen = np.isfinite(points).all(axis=2)
        missing.append(1 - seen.mean())
        in_floor = points[seen] @ matrix[:3, :3].T + matrix[:3, 3]
        in_camera = poses[timestamp, sensor].transform_points(in_floor)
        model, width, height, *params = theirs.sensors[sensor].sensor_params
        camera = pycolmap.Camera(
            model=model, width=int(width), height=int(height), params=list(map(float, params))
        )
        pixels = camera.img_from_cam(in_camera)
        np.testing.assert_allclose(pixels, np.column_stack([columns[seen], rows[seen]]), atol=1e-3)
        path = imported / "mapping" / "sensors" / "records_data" / depths[timestamp]
        depth = read_depth_map(path, width=64, height=48)
        np.testing.assert_allclose(depth[seen], in_camera[:, 2], rtol=1e-6)
        assert (depth[~seen] == 0).all()
    assert 0.02 < np.mean(missing) < 0.3


def test_the_matrix_before_refinement_is_another(root: Path) -> None:
    for path in root.glob("database/alignments/*/transformations/*.txt"):
        lines = path.read_text().splitlines()
        before, after = (
            np.array([line.split() for line in lines[first : first + 4]], float) for first in (1, 7)
        )
        assert 0.005 < np.linalg.norm(before[:3, 3] - after[:3, 3]) < 0.5


def test_conditions_come_from_the_truth(root: Path, imported: Path) -> None:
    groups = read_groups(imported / "megloc")
    queries = {name: group for name, group in groups.items() if name.startswith("query/")}
    assert Counter(group.condition for group in queries.values()) == {"DUC1": 2, "DUC2": 3}
    assert {group.frame for group in queries.values()} == {""}
    dataset = InLoc(InLocOptions(depth=False)).read(root)
    assert any("queries taken on DUC1" in str(count) for count in dataset.summary)
    KaptureFolder(imported / "mapping").validate(deep=True)
    KaptureFolder(imported / "query").validate(deep=True)


def test_the_default_twin_is_real_work() -> None:
    options = InLocTwinOptions()
    zones = [zone for floor in options.builder().floors(0, 2) for zone in floor.zones]
    assert len(zones) * 36 >= 80
    assert options.queries >= 40
    kinds = Counter(zone.kind for zone in zones)
    assert all(count >= 4 for count in kinds.values())  # each kind two times on each floor


@pytest.mark.slow
def test_processes_write_the_same_bytes(root: Path, tmp_path: Path) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        write_inloc_twin(tmp_path, SMALL, executor)

    def hashes(folder: Path) -> dict[str, str]:
        return {
            path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }

    assert hashes(tmp_path) == hashes(root)
