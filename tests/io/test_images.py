"""Images, depth maps and the cameras of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageOps
from PIL.TiffImagePlugin import IFDRational

from megloc_kapture.errors import DataError
from megloc_kapture.io.images import (
    EXIF_DEVIATION,
    GUESS_DEVIATION,
    WRITABLE_SUFFIXES,
    guessed_camera,
    image_size,
    is_image,
    photo_of,
    pillow_pixels,
    read_image_rgb,
    read_photo,
    turned_upright,
    write_image,
)
from megloc_kapture.values import Camera

RNG = np.random.default_rng(0)
PIXELS = RNG.integers(0, 256, (40, 60, 3), dtype=np.uint8)
SMOOTH = cv2.resize(PIXELS[:4, :6], (60, 40), interpolation=cv2.INTER_LINEAR)


@pytest.mark.parametrize("suffix", [*WRITABLE_SUFFIXES, ".JPEG"])
def test_written_images_read_back_with_equal_bytes_each_time(tmp_path: Path, suffix: str) -> None:
    a, b = (tmp_path / (name + suffix) for name in "ab")
    for path in (a, b):
        write_image(path, SMOOTH)
    assert a.read_bytes() == b.read_bytes()
    assert np.abs(read_image_rgb(a).astype(int) - np.asarray(Image.open(a))).max() <= 4  # not BGR
    lossy = suffix.lower() in (".jpg", ".jpeg")
    assert np.abs(read_image_rgb(a).astype(int) - SMOOTH).mean() <= 4 * lossy
    assert image_size(a) == (60, 40)


def test_grey_deep_and_transparent_images_are_read_as_rgb_of_8_bits(tmp_path: Path) -> None:
    grey, path = PIXELS[:, :, 0], tmp_path / "a.png"
    write_image(path, grey)
    assert Image.open(path).mode == "L"
    assert np.array_equal(read_image_rgb(path), np.repeat(grey[:, :, None], 3, axis=2))
    Image.fromarray(grey.astype(np.uint16) * 257).save(path)
    assert np.array_equal(read_image_rgb(path), np.repeat(grey[:, :, None], 3, axis=2))
    alpha = RNG.integers(0, 256, (40, 60, 1), dtype=np.uint8)
    Image.fromarray(np.concatenate([PIXELS, alpha], axis=2)).save(path)
    assert np.array_equal(read_image_rgb(path), PIXELS)


def spread(low: float, high: float) -> np.ndarray:
    """An image (40, 60) that uses this range evenly."""
    return np.linspace(low, high, 2400).reshape(40, 60)


@pytest.mark.parametrize(
    ("name", "deep"),
    [
        ("thermal.png", spread(8000, 8765).astype(np.uint16)),
        ("float.tif", spread(0, 1).astype(np.float32)),
        ("long.tif", spread(-5000, 5000).astype(np.int32)),
    ],
)
def test_deep_images_use_8_bits(name: str, deep: np.ndarray, tmp_path: Path, capfd: Any) -> None:
    Image.fromarray(deep).save(tmp_path / name)
    expected = spread(0, 255)[:, :, None]
    pixels = read_image_rgb(tmp_path / name)
    assert pixels.dtype == np.uint8 and np.abs(pixels - expected).max() <= 1.01
    with Image.open(tmp_path / name) as image:
        assert np.array_equal(pillow_pixels(image), pixels)
    assert capfd.readouterr().err == ""


# -------------------------------------------------------------------------------------- photographs


MAKE, MODEL, ORIENTATION, EXIF, FOCAL_MM, FOCAL_35MM = 0x10F, 0x110, 0x112, 0x8769, 0x920A, 0xA405
RESOLUTION_X, RESOLUTION_UNIT = 0xA20E, 0xA210


def exif_of(tags: dict[int, object], inner: dict[int, object]) -> Image.Exif:
    exif = Image.Exif()
    exif.update(tags)
    exif.get_ifd(EXIF).update(inner)
    return exif


def noise(width: int = 64, height: int = 48) -> Image.Image:
    rng = np.random.default_rng(0)
    return Image.fromarray(rng.integers(0, 255, (height, width, 3), dtype=np.uint8))


@pytest.mark.parametrize(
    ("tags", "inner"),
    [
        ({}, {}),
        ({ORIENTATION: 6}, {FOCAL_35MM: 50}),
        ({MAKE: "Canon", MODEL: "Canon PowerShot S95"}, {FOCAL_MM: IFDRational(6)}),
        ({MAKE: "Nobody", MODEL: "Nothing"}, {FOCAL_MM: IFDRational(18)}),
        (
            {MAKE: "x", MODEL: "y"},
            {FOCAL_MM: IFDRational(6), RESOLUTION_X: IFDRational(5000), RESOLUTION_UNIT: 3},
        ),
    ],
)
def test_photographs_have_colmaps_camera(tags: Any, inner: Any, tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    noise().save(path, exif=exif_of(tags, inner))
    theirs = pycolmap.infer_camera_from_image(str(path))
    ours = read_photo(path).camera
    known = theirs.has_prior_focal_length
    assert ours.focal_deviation == (EXIF_DEVIATION if known else GUESS_DEVIATION)
    assert (ours.model, ours.width, ours.height) == (theirs.model.name, 64, 48)
    np.testing.assert_allclose(ours.params, theirs.params, rtol=1e-12)
    same = Camera.from_colmap(theirs)
    assert same.params == ours.params and same.focal_deviation == 0


@pytest.mark.parametrize(
    ("orientation", "suffix"), [*((number, ".jpg") for number in range(1, 9)), (6, ".tif")]
)
def test_photos_are_rotated_as_by_pillow(orientation: int, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"photo{suffix}"
    noise().save(path, exif=exif_of({ORIENTATION: orientation}, {}))
    photo = read_photo(path)
    turned = turned_upright(read_image_rgb(path), photo.orientation)
    with Image.open(path) as image:
        truth = np.asarray(ImageOps.exif_transpose(image))
    assert np.abs(turned.astype(int) - truth).max() <= 4  # decoders differ in their last bits
    camera = photo.upright_camera
    assert (camera.height, camera.width) == turned.shape[:2]
    assert camera.params[1:3] == (camera.width / 2, camera.height / 2)


def test_the_gps_position_of_a_photograph() -> None:
    latitude = (47, IFDRational(45, 2), IFDRational(0, 0))
    position = {1: "N", 2: latitude, 3: "W", 4: (8.0, 32.5), 6: 400}
    image = noise()
    exif = exif_of({MAKE: "Acme\0", MODEL: "P1", ORIENTATION: 6}, {FOCAL_35MM: 28})
    exif.get_ifd(0x8825).update(position)
    image.info["exif"] = exif.tobytes()
    photo = photo_of(image)
    assert (photo.orientation, photo.make) == (6, "Acme P1")
    assert photo.gps == pytest.approx((47.375, -8.541667, 400.0), abs=1e-6)


def test_an_impossible_focal_length_in_exif_counts_as_missing(tmp_path: Path) -> None:
    noise().save(tmp_path / "a.jpg", exif=exif_of({}, {FOCAL_35MM: 65535}))
    assert read_photo(tmp_path / "a.jpg").camera == guessed_camera(64, 48)


def test_images_are_recognised_by_their_content(tmp_path: Path) -> None:
    formats = {"a.jfif": "JPEG", "frame.000007": "JPEG", "noname": "PNG", "b.pgm": "PPM"}
    formats |= {"c.jp2": "JPEG2000", "d.gif": "GIF", "e.txt": "WEBP"}
    for name, written in formats.items():
        noise().convert("L" if written == "PPM" else "RGB").save(tmp_path / name, written)
        assert is_image(tmp_path / name)
        assert read_photo(tmp_path / name).camera.width == 64
        assert read_image_rgb(tmp_path / name).shape == (48, 64, 3)
        write_image(tmp_path / name, SMOOTH)
        lossy = name in ("a.jfif", "frame.000007", "noname", "e.txt")
        assert np.abs(read_image_rgb(tmp_path / name).astype(int) - SMOOTH).mean() <= 4 * lossy
    (tmp_path / "f.json").write_bytes(b"{}")
    noise(16, 16).save(tmp_path / "g", "ICO")
    assert not any(is_image(tmp_path / name) for name in ("f.json", "g", "nowhere"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("text/a/1.jpg", "; .*text is a file, perhaps a link"),
        ("a/1.jpg", "$"),
        ("moved/a/1.jpg", "; .* a link to .*elsewhere, which is"),
        ("moved", "; .* a link to .*elsewhere, which is"),
        ("img_1.jpg", "; 'IMG_1.JPG' differs in case"),
        ("é.jpg", "; 'e\u0301.jpg' differs in case"),
        (".", "; it is a folder"),
    ],
)
def test_a_missing_image_has_a_reason(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "text").write_text("../elsewhere")
    (tmp_path / "moved").symlink_to("elsewhere")
    for stored in ("IMG_1.JPG", "e\u0301.jpg"):
        (tmp_path / stored).touch()
    with pytest.raises(DataError, match=f"no such image{message}"):
        read_image_rgb(tmp_path / name)
