"""``megloc localize --images``: photographs and videos without cameras."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir
from PIL import Image

from megloc_kapture.cli.main import main
from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.io.images import image_size, write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import read_status

# upright, and a camera held sideways, by EXIF
ORIENTATIONS = (1, 6)


def photograph(source: Path, path: Path, *, orientation: int = 1, focal_35mm: int = 0) -> None:
    """Write the image as a camera with square pixels stores it in this orientation."""
    exif = Image.Exif()
    exif[0x112] = orientation
    if focal_35mm:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    with Image.open(source) as image:
        if image.size == (400, 300):  # the rendered room's, 300 px wide and 302 px high
            image = image.resize((400, 298))
        stored = image.transpose(Image.Transpose.ROTATE_90) if orientation == 6 else image
        path.parent.mkdir(parents=True, exist_ok=True)
        stored.save(path, exif=exif, quality=95)


@pytest.fixture(scope="module")
def localized(
    finished: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """Result and output of localizing rotated photographs, unusable files and a video."""
    root = tmp_path_factory.mktemp("photographs")
    query, place = KaptureFolder(scene / "query"), root / "photos"
    for orientation in ORIENTATIONS:
        path = place / f"my dir/{orientation}.jpg"
        focal = 0 if orientation == 1 else 26
        image = query.image_path("0004.jpg")
        photograph(image, path, orientation=orientation, focal_35mm=focal)
    content = (place / "my dir" / "1.jpg").read_bytes()
    (place / "cut.jpg").write_bytes(content[: len(content) // 2])
    (place / "empty.jpg").touch()
    (place / "phone.HEIC").write_bytes(b"x")
    write_image(place / "grey.png", np.full((300, 400), 128, np.uint8))
    size, film = (400, 298), str(place / "walk.avi")
    writer = cv2.VideoWriter(film, cv2.VideoWriter.fourcc(*"MJPG"), 10, size)
    for name in query.read().image_names()[:2]:
        for _ in range(16):
            writer.write(cv2.resize(cv2.imread(str(query.image_path(name))), size))
    writer.release()
    places = ["-i", finished / "map", "--images", place, "-o", root / "out", "--every", "16"]
    with pytest.raises(SystemExit) as end, redirect_stdout(io.StringIO()) as printed:
        main(["localize", *map(str, places), "-q"])
    assert end.value.code == 0
    return root / "out", printed.getvalue()


def test_usable_photographs_and_frames_are_localized(localized: tuple[Path, str]) -> None:
    out, printed = localized
    assert printed.startswith("4 of 8 queries localized in ")
    statuses = read_status(out / "status.csv")
    reasons = {name: row.reason for name, row in statuses.items() if row.status == "failed"}
    assert set(reasons) == {"cut.jpg", "empty.jpg", "phone.HEIC", "grey.png"}
    assert "broken" in reasons["cut.jpg"] and ".HEIC cannot be read" in reasons["phone.HEIC"]
    succeeded = [row for row in statuses.values() if row.num_inliers]
    assert all("focal length estimated" in row.remarks[0] for row in succeeded)


def test_the_result_has_upright_images_with_their_estimated_cameras(
    localized: tuple[Path, str], scene: Path
) -> None:
    out = KaptureFolder(localized[0])
    data = out.read()
    truth = KaptureFolder(scene / "query_gt").read().poses()["0004.jpg"]
    theirs = kapture_from_dir(str(out.root))
    assert len(theirs.records_camera.data_list()) == 6 == len(data.image_names())
    for orientation in ORIENTATIONS:
        name = f"my dir/{orientation}.jpg"
        assert np.linalg.norm(data.poses()[name].center() - truth.center()) < 0.05
        camera = data.camera_of(name)
        assert camera.params[0] == pytest.approx(300, rel=0.015)
        assert image_size(out.image_path(name)) == (camera.width, camera.height)
        assert out.image_path(name).is_symlink() == (orientation == 1)


# ------------------------------------------------------------------ real photographs


@pytest.fixture(scope="module")
def facade(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scene with surveyed poses, and a map of it."""
    scene = shared_data / "scenes" / "fountain_p11"
    workspace = tmp_path_factory.mktemp("facade") / "workspace"
    command = ["eval", "kapture", "--root", str(scene), "--workspace", str(workspace)]
    with pytest.raises(SystemExit):
        main([*command, "--until", "map", "--executor", "inline", "-q"])
    return scene, workspace / "map"


# The focal length is 1381 px, 32.4 mm of 35 mm film; the images are without distortion, but their
# principal point is 11 px off the middle, which is unknown to the command.
@pytest.mark.slow
@pytest.mark.parametrize("focal_35mm", [0, 32, 42], ids=["no EXIF", "true EXIF", "30 % too long"])
def test_real_photographs(
    megloc: Any, facade: tuple[Path, Path], focal_35mm: int, tmp_path: Path
) -> None:
    scene, kapture_map = facade
    for path in (scene / "query").rglob("*.jpg"):
        photograph(path, tmp_path / "photos" / path.name, focal_35mm=focal_35mm)
    out = tmp_path / "out"
    done = megloc("localize", "-i", kapture_map, "--images", tmp_path / "photos", "-o", out)
    assert done.status == 0
    data = KaptureFolder(out).read()
    assert data.poses().keys() == set(data.image_names())
    for name in data.image_names():
        assert data.camera_of(name).params[0] == pytest.approx(1381, rel=0.015)
    row = evaluate(out, scene / "query_gt").row()
    assert row.median_position_m is not None and row.median_angle_deg is not None
    assert row.median_position_m < 0.07 and row.median_angle_deg < 0.15
