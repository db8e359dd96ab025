"""Photographs' EXIF, against COLMAP's reading of the same files and pillow's turning of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps
from PIL.TiffImagePlugin import IFDRational

from megloc_kapture.errors import DataError
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.photos import (
    EXIF_DEVIATION,
    GUESS_DEVIATION,
    photo_of,
    read_photo,
    turned_upright,
)
from megloc_kapture.values import Camera

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
        ({}, {FOCAL_35MM: 28}),
        ({ORIENTATION: 6}, {FOCAL_35MM: 50}),
        ({MAKE: "Canon", MODEL: "Canon PowerShot S95"}, {FOCAL_MM: IFDRational(6)}),
        ({MAKE: "NIKON CORPORATION", MODEL: "NIKON D70"}, {FOCAL_MM: IFDRational(18)}),
        ({MAKE: "Nobody", MODEL: "Nothing"}, {FOCAL_MM: IFDRational(18)}),
        (
            {MAKE: "x", MODEL: "y"},
            {FOCAL_MM: IFDRational(6), RESOLUTION_X: IFDRational(5000), RESOLUTION_UNIT: 3},
        ),
    ],
)
def test_the_camera_is_that_of_colmap(
    tags: dict[int, object], inner: dict[int, object], tmp_path: Path
) -> None:
    path = tmp_path / "photo.jpg"
    noise().save(path, exif=exif_of(tags, inner))
    theirs = pycolmap.infer_camera_from_image(str(path))
    ours = Camera.from_exif(path)
    known = theirs.has_prior_focal_length
    assert ours.focal_deviation == (EXIF_DEVIATION if known else GUESS_DEVIATION)
    assert (ours.model, ours.width, ours.height) == (theirs.model.name, 64, 48)
    np.testing.assert_allclose(ours.params, theirs.params, rtol=1e-12)
    same = Camera.from_colmap(theirs)
    assert same.params == ours.params and same.focal_deviation == 0


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_pixels_and_camera_are_turned_as_pillow_turns(
    orientation: int, suffix: str, tmp_path: Path
) -> None:
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


@given(st.binary(max_size=200), st.integers(0, 200))
def test_broken_exif_is_as_none(junk: bytes, at: int) -> None:
    whole = exif_of({MAKE: "Canon", ORIENTATION: 6}, {FOCAL_35MM: 28}).tobytes()
    image = noise()
    image.info["exif"] = whole[:at] + junk
    photo = photo_of(image)
    assert photo.orientation in range(1, 9)
    assert photo.camera.width == 64 and photo.camera.params[0] > 0


def test_what_is_no_photograph_is_refused(tmp_path: Path) -> None:
    for name, content, said in (
        ("empty.jpg", b"", "not an image, or broken"),
        ("text.jpg", b"hello", "not an image, or broken"),
        ("phone.heic", b"x", r"\.heic cannot be read; .*\.jpg"),
        ("noname", b"x", "such a file cannot be read"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=said):
            read_photo(tmp_path / name)
    with pytest.raises(DataError, match="no such image"):
        read_photo(tmp_path / "nowhere.jpg")
