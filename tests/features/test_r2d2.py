"""R2D2 against keypoints that kapture's authors extracted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from megloc_kapture.features.r2d2 import R2D2, R2D2Options, pyramid_levels
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "r2d2" / "r2d2_WASF_N16.pt")


def extractor(weights: str, **options: object) -> R2D2:
    given = {"max_keypoints": 100_000, "device": "cpu", "min_size": 130, "max_size": 160}
    return R2D2(R2D2Options.model_validate(given | {"weights": weights, **options}))


def test_the_coarsest_level_equals_the_published_keypoints(shared_data: Path, weights: str) -> None:
    """virtual_gallery has the best 500 keypoints of three levels."""
    folder = KaptureFolder(shared_data / "foreign_maps" / "virtual_gallery" / "query")
    name = folder.read().image_names()[0]
    stored = folder.keypoints("r2d2_500").read(name)
    descriptors = folder.descriptors("r2d2_500").read(name)
    coarsest = stored[:, 2] > 85
    stored, descriptors = stored[coarsest][::-1], descriptors[coarsest][::-1]  # worst came first
    assert len(stored) > 80

    plugin = extractor(weights, max_keypoints=len(stored), min_size=580, max_size=700)
    result = plugin.extract(read_image_rgb(folder.image_path(name)))
    # stored keypoints count from the centre of each level's first pixel, not from its corner
    ratio = np.array([1920 / 679, 1080 / 382], np.float32)
    offset = result.keypoints_px[:, None, :2] - (stored[:, :2] + ratio / 2)
    distance = np.linalg.norm(offset, axis=2)
    nearest = distance.argmin(axis=0)
    assert len(np.unique(nearest)) == len(stored)
    assert distance.min(axis=0).max() < 0.01
    cosine = (result.descriptors[nearest] * descriptors).sum(axis=1)
    assert cosine.min() > 0.999
    # in the same order, but for scores that are all but equal
    assert np.abs(nearest - np.arange(len(stored))).max() <= 2
    np.testing.assert_allclose(result.keypoints_px[:, 2], stored[0, 2], rtol=1e-3)


def test_sizes_without_a_level_between_them_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"max_size must be at least 1\.2 times min_size"):
        R2D2Options(min_size=1000, max_size=1024)


@pytest.mark.parametrize(
    ("size", "limits", "expected"),
    [
        # width and height, four levels an octave
        (
            (640, 480),
            (256, 1024),
            [(640, 480), (538, 404), (453, 339), (381, 285), (320, 240), (269, 202)],
        ),
        # levels above the limit are computed, not returned
        ((1920, 1080), (600, 1024), [(960, 540), (807, 454), (679, 382)]),
        # an image smaller than the limits is used as it is
        ((80, 60), (256, 1024), [(80, 60)]),
    ],
)
def test_levels_of_the_pyramid(
    size: tuple[int, int], limits: tuple[int, int], expected: list[tuple[int, int]]
) -> None:
    image = torch.zeros(1, 1, *size[::-1])
    levels = pyramid_levels(image, min_size=limits[0], max_size=limits[1])
    assert [(level.shape[-1], level.shape[-2]) for level in levels] == expected
