"""``megloc preprocess``: flags, what it says, and what it leaves behind."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.cli.stages import Preprocess
from megloc_kapture.errors import OptionError
from megloc_kapture.io.images import image_size, read_image_rgb, write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.preprocessing.masks import FixedMask

INLINE = ("--executor", "inline")


@pytest.fixture
def camera(scene: Path) -> str:
    """Id of the scene's camera."""
    return KaptureFolder(scene / "query").read().record_of(images_of(scene)[0])[1]


def images_of(scene: Path) -> list[str]:
    return KaptureFolder(scene / "query").read().image_names()


def flags(*arguments: str) -> Preprocess:
    """The command as these arguments make it."""
    import tyro

    given = ["-i", "in", "-o", "out", *arguments]
    return tyro.cli(Preprocess, args=given, config=(tyro.conf.OmitArgPrefixes,))


def test_flags_make_the_options() -> None:
    options = flags(
        *("--resize", "1600", "--undistort", "--set", "upscale=true", "--unchanging"),
        *("--bottom-share", "rear=0.2", "--bottom-share", "left/a=b*.jpg=0.1"),
        *("--polygon", "c=0,0.8 1,0.8 1,1", "--mask-file", "c=a/b.png"),
        *("--segmenter", "deeplab", "--dynamic", "car", "bus", "--user-masks", "m"),
    ).options()
    assert (options.max_size_px, options.undistort, options.upscale) == (1600, True, True)
    assert options.masks.fixed == (
        FixedMask(camera="rear", bottom_share=0.2),
        FixedMask(camera="left/a=b*.jpg", bottom_share=0.1),
        FixedMask(camera="c", polygon=((0, 0.8), (1, 0.8), (1, 1))),
        FixedMask(camera="c", file=Path("a/b.png")),
    )
    masks = options.masks
    assert masks.segmenter is not None and masks.segmenter.name == "deeplab"
    assert masks.dynamic == ("car", "bus") and masks.user_masks == Path("m") and masks.unchanging


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--bottom-share", "0.2"), "--bottom-share takes CAMERA=VALUE, got '0.2'"),
        (("--bottom-share", "c=2"), r"bottom_share: .*less than 1"),
        (("--polygon", "c=0,0 1,1"), "at least 3"),
        (("--polygon", "c=0,0 1,1 1"), r"polygon\.2"),
        (("--resize", "0"), "max_size_px: .*greater than 0"),
        (("--set", "resize=1600"), "unknown option 'resize'; known: .*max_size_px"),
    ],
)
def test_values_that_cannot_be_used(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        flags(*arguments).options()


def test_images_are_resized_and_masked(
    megloc: Any, scene: Path, camera: str, tmp_path: Path, contents: Callable[[Path], Any]
) -> None:
    before = contents(scene / "query")
    out = tmp_path / "new"
    small = ("preprocess", "-i", scene / "query", "-o", out, "--resize", "200", *INLINE)
    done = megloc(*small, "--bottom-share", f"{camera}=0.25")
    assert done.status == 0, done.err
    assert contents(scene / "query") == before
    assert "4 images, 4 of them changed" in done.err
    assert "PINHOLE 400x300 -> PINHOLE 200x144" in done.err
    assert re.search(r"fixed masks +22\.22 %", done.err)
    new = KaptureFolder(out)
    new.validate(deep=True)
    image = images_of(scene)[0]
    assert image_size(new.image_path(image)) == (200, 144)
    mask = read_image_rgb(out / "sensors" / "masks" / f"{image}.png")[..., 0]
    assert set(np.unique(mask)) == {0, 255} and (mask[-30:] == 0).all()

    # again without the mask: nothing of the first run is left
    assert megloc(*small).status == 0
    assert not (out / "sensors" / "masks").exists()
    assert [p.name for p in sorted(out.iterdir())] == [".megloc", "sensors"]


def test_nothing_to_do_links_and_an_unknown_camera_is_remarked(
    megloc: Any, scene: Path, tmp_path: Path
) -> None:
    place = ("-i", scene / "query", "-o", tmp_path / "new")
    done = megloc("preprocess", *place, "--bottom-share", "rear=0.1", *INLINE)
    assert done.status == 0
    assert "4 images, 0 of them changed" in done.err
    assert "remark: a fixed mask fits no image: rear" in done.err
    assert (tmp_path / "new" / "sensors" / "records_data").is_symlink()


def test_a_mask_brought_along(megloc: Any, scene: Path, tmp_path: Path) -> None:
    name = f"masks/{images_of(scene)[0]}.png"
    mask = np.full((300, 400), 255, np.uint8)
    mask[:, :384] = 0
    write_image(tmp_path / name, mask)
    places = ("-i", scene / "query", "-o", tmp_path / "new", "--user-masks", tmp_path / "masks")
    done = megloc("preprocess", *places, "--quiet")
    assert (done.status, done.err) == (0, "")
    written = read_image_rgb(tmp_path / "new" / "sensors" / name)[..., 0]
    np.testing.assert_array_equal(written, mask)


def test_what_cannot_be_done_is_said_in_a_line(
    megloc: Any, scene: Path, tmp_path: Path, camera: str
) -> None:
    out = tmp_path / "new"
    command = ("preprocess", "-i", scene / "query", "-o", out, *INLINE)
    none = tmp_path / "none"
    for flag, value, words in (
        ("--segmenter", "nobody", "no plugin 'nobody' .*segmenters"),
        ("--mask-file", f"{camera}={tmp_path}/x.png", r"x\.png: no such mask"),
        ("--user-masks", none, "none: no such folder of masks"),
        ("--sequence", none, "none: no such folder"),
        ("--dynamic", "car", "need a segmenter"),
    ):
        megloc(*command, flag, value).refused(words)
    megloc(*command, "--unchanging").refused("it has 4 images, and at least 10")
    assert not out.exists()
    inside = scene / "query" / "new"
    megloc(*command[:4], inside).refused("is inside the input kapture folder")
    assert not inside.exists()
