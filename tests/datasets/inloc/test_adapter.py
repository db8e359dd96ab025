"""InLoc, on a small download written by hand: a scan on each of two floors."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from inloc_files import write_download
from PIL import Image

from megloc_kapture.datasets.inloc.adapter import InLoc, InLocOptions, read_cutout_points
from megloc_kapture.datasets.official import OfficialDataset, write_official
from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.dataset_tables import read_side_tables
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera


@pytest.fixture(scope="module")
def downloaded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_download(tmp_path_factory.mktemp("data") / "InLoc")


def imported(root: Path, output: Path, **options: object) -> Path:
    write_official(read(root, **options), output)
    return output


def read(root: Path, *, allow_missing: bool = False, **options: object) -> OfficialDataset:
    return InLoc(InLocOptions.model_validate(options)).read(root, allow_missing=allow_missing)


@pytest.fixture(scope="module")
def output(downloaded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported(downloaded, tmp_path_factory.mktemp("imported") / "out")


def test_depth_maps_may_be_thinned(downloaded: Path, output: Path, tmp_path: Path) -> None:
    cameras, depths = [], []
    for place in (output, imported(downloaded, tmp_path / "out", depth_step=3)):
        folder = KaptureFolder(place / "mapping")
        (_, sensor), name = next(iter(folder.read().records_depth.items()))
        camera = folder.read().sensors[sensor].camera()
        size = {"width": camera.width, "height": camera.height}
        cameras.append(camera)
        depths.append(read_depth_map(folder.depth_path(name), **size))
    np.testing.assert_array_equal(depths[1], depths[0][::3, ::3])
    # a pixel of the thinned map is one of the whole map
    pixels = np.array([[0.5, 0.5], [1.5, 2.5]]), np.array([[0.5, 0.5], [3.5, 6.5]])
    thinned, whole = map(bearing_rays, cameras[::-1], pixels)
    np.testing.assert_allclose(thinned, whole, atol=1e-12)


def test_cameras_have_the_focal_lengths_of_the_paper(root: Path) -> None:
    name = "database/cutouts/DUC1/024/DUC_cutout_024_0_0.jpg"
    for file, size in (
        ("query/iphone7/IMG_0801.JPG", (4032, 3024)),
        ("query/iphone7/IMG_0803.JPG", (3024, 4032)),
        (name, (1600, 1200)),
    ):
        Image.new("L", size).save(root / file, format="JPEG")
    data = read(root)
    landscape, upright = (data.query.camera_of(f"query/iphone7/IMG_080{n}.JPG") for n in (1, 3))
    assert landscape == Camera("SIMPLE_PINHOLE", 4032, 3024, (3136.0, 2016.0, 1512.0))
    assert upright == Camera("SIMPLE_PINHOLE", 3024, 4032, (3136.0, 1512.0, 2016.0))
    params = data.mapping.camera_of(name).params
    np.testing.assert_allclose(params, (1385.6406460551, 800, 600), rtol=1e-13)


def test_queries_are_imported_as_stored(downloaded: Path, output: Path) -> None:
    query = KaptureFolder(output / "query")
    query.validate(deep=True)
    names = [f"query/iphone7/{n}" for n in ("IMG_0801.JPG", "IMG_0802.jpg", "IMG_0803.JPG")]
    assert query.read().image_names() == names
    assert not query.read().trajectories
    turned = query.read().camera_of(names[1])
    assert (turned.width, turned.height) == (64, 48)
    assert len(query.read().sensors) == 2
    listed = list(read_side_tables(output / "megloc").names.items())
    assert listed == [(name, name.split("/")[-1]) for name in names]
    for name in names:
        link = query.root / "sensors" / "records_data" / name
        assert link.resolve() == downloaded / name and link.parent.is_symlink()


def test_each_floor_is_a_coordinate_frame(output: Path) -> None:
    mapping, groups = KaptureFolder(output / "mapping"), read_side_tables(output / "megloc").groups
    mapping.validate(deep=True)
    for image in mapping.read().image_names():
        floor = image.split("/")[2]
        assert (groups[image].frame, groups[image].location) == (floor, f"{floor}/024")
    assert {groups[i].frame for i in KaptureFolder(output / "query").read().image_names()} == {""}
    assert read_side_tables(output / "megloc").protocol.conditions == ("DUC1", "DUC2")
    assert not (output / "query_gt").exists()


def test_distractor_floors_are_imported_on_request(root: Path) -> None:
    for part in ("cutouts", "alignments"):
        folder = Path(
            shutil.copytree(root / f"database/{part}/DUC1", root / f"database/{part}/CSE3")
        )
        for path in sorted(folder.rglob("DUC_*")):
            path.rename(path.with_name(path.name.replace("DUC_", "cse_")))
    assert len(read(root).mapping.records_camera) == 72
    dataset = read(root, distractor_floors=True, allow_missing=True)
    assert len(dataset.mapping.records_camera) == 108
    assert dataset.groups["database/cutouts/CSE3/024/cse_cutout_024_30_-30.jpg"].frame == "CSE3"
    cutouts = root / "database" / "cutouts"
    assert dataset.missing is not None
    assert dataset.missing.files == [cutouts / "CSE4", cutouts / "CSE5"]


def test_wrongly_placed_scans_are_skipped(root: Path) -> None:
    (root / "database/alignments/DUC1/know_incorrect.txt").write_text("024\n")
    dataset = read(root)
    assert {group.frame for group in dataset.groups.values()} == {"DUC2", ""}
    assert any("wrongly placed: scans DUC1/024" in remark for remark in dataset.remarks)


@pytest.mark.parametrize(
    ("moves", "place"),
    [
        ({"database": "dataset/database", "query": "dataset/query"}, "dataset/database/cutouts"),
        ({"database/cutouts": "cutouts", "database/alignments": "alignments"}, "cutouts"),
        ({"database": "dataset"}, "dataset/cutouts"),
        ({"database/cutouts": "database/cutouts_imageonly"}, "database/cutouts_imageonly"),
    ],
)
def test_layouts_of_redistributions_are_accepted(
    root: Path, tmp_path: Path, moves: dict[str, str], place: str
) -> None:
    for old, new in moves.items():
        (root / new).parent.mkdir(exist_ok=True)
        (root / old).rename(root / new)
    mapping = KaptureFolder(imported(root, tmp_path / "out") / "mapping")
    mapping.validate(deep=True)
    name = "DUC2/024/DUC_cutout_024_30_-30.jpg"
    assert mapping.image_path(f"database/cutouts/{name}").resolve() == root / place / name


def test_points_of_matlab_7_3_are_refused_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(384))
    with pytest.raises(DataError, match="version 7.3; .* save it with -v7"):
        read_cutout_points(path, 2, 2)


def test_a_download_without_points_is_imported_without_depth(root: Path, tmp_path: Path) -> None:
    for path in root.rglob("*.mat"):
        path.unlink()
    with pytest.raises(DataError, match="to import without points, set the option depth = false"):
        read(root)
    output = imported(root, tmp_path / "out", depth=False)
    assert len(KaptureFolder(output / "mapping").read().poses()) == 72
