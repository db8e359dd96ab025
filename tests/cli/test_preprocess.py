"""``megloc preprocess``: flags, printed counts and written files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.cli.stages import Preprocess
from megloc_kapture.io.images import image_size, read_image_rgb
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
    """Return the command with these arguments."""
    import tyro

    given = ["-i", "in", "-o", "out", *arguments]
    return tyro.cli(Preprocess, args=given, config=(tyro.conf.OmitArgPrefixes,))


def test_flags_are_converted_to_options() -> None:
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
    assert "masked (fixed): 22.22 % of all pixels" in done.err
    new = KaptureFolder(out)
    new.validate(deep=True)
    image = images_of(scene)[0]
    assert image_size(new.image_path(image)) == (200, 144)
    mask = read_image_rgb(out / "sensors" / "masks" / f"{image}.png")[..., 0]
    assert mask.shape == (144, 200)
    assert set(np.unique(mask)) == {0, 255} and (mask[-30:] == 0).all()

    # a second run without the mask leaves no mask of the first
    assert megloc(*small).status == 0
    assert not (out / "sensors" / "masks").exists()
    assert [p.name for p in sorted(out.iterdir())] == [".megloc", "sensors"]
