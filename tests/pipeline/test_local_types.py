"""Descriptors of a map that came without are extracted again."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.live_source import extract_again, local_types_of
from megloc_kapture.pipeline.presets import options_of_preset


@pytest.fixture
def stripped(map_copy: Path) -> KaptureMap:
    """Our map, of 800 keypoints an image, without its descriptors."""
    shutil.rmtree(map_copy / "reconstruction" / "descriptors")
    return KaptureMap.open(map_copy)


def again(opened: KaptureMap, **options: float) -> dict[str, np.ndarray]:
    """The descriptors of the map's only type, by an extractor of these options."""
    extractor = RootSift(RootSiftOptions(**options))  # type: ignore[arg-type]
    return extract_again(opened, opened.keypoints["rootsift"], extractor)


@pytest.mark.parametrize("number", [800, 400])
def test_what_is_found_again_has_the_descriptors_it_had(
    workspace: Path, stripped: KaptureMap, number: int
) -> None:
    original = KaptureMap.open(workspace / "map")
    found = again(stripped, max_keypoints=number)
    assert sorted(found) == original.images
    for image, descriptors in found.items():
        known = descriptors.any(axis=1)
        assert 0.75 * number < known.sum() <= number
        stored = original.keypoints["rootsift"].descriptors(image)
        np.testing.assert_array_equal(descriptors[known], stored[known])
        assert number < 800 or known.all()


def test_a_map_of_another_extractor_or_without_images_is_refused(stripped: KaptureMap) -> None:
    with pytest.raises(DataError, match=r"finds only \d+ of \d+ observed keypoints"):
        again(stripped, contrast_threshold=0.2)
    (stripped.folder.root / "sensors" / "records_data").unlink()
    with pytest.raises(DataError, match="no descriptors of type 'rootsift', and no images"):
        again(KaptureMap.open(stripped.folder.root))


@pytest.mark.parametrize(
    ("name", "config", "dtype", "expected"),
    [
        ("SIFT", "SIFT", "uint8", "sift"),
        ("Root-SIFT", "x", "uint8", "sift"),
        ("sift", "sift", "float32", "rootsift"),
        ("RootSIFT", "x", "float32", "rootsift"),
        ("sift_8192", "x", "uint8", "sift"),
        ("SuperPoint", "x", "float32", "superpoint"),
        ("SuperPoint-v1", "x", "float32", "superpoint superpoint_v1"),
        ("ALIKED", "x", "float32", "aliked"),
        ("ALIKED_N16ROT", "x", "float32", "aliked aliked-n16rot"),
        ("R2D2", "x", "float32", "r2d2"),
        ("r2d2_500", "x", "float32", "r2d2"),
        ("R2D2-WASF-N16", "x", "float32", "r2d2 r2d2_WASF_N16"),
        ("mine", "Aliked", "float32", "aliked"),
        ("D2-Net", "d2net", "float32", None),
        ("superpoint_night", "x", "float32", None),
        ("orb_800", "x", "uint8", None),
    ],
)
def test_extractors_are_known_by_what_tools_call_their_types(
    name: str, config: str, dtype: str, expected: str | None, map_copy: Path
) -> None:
    reconstruction = map_copy / "reconstruction"
    for kind, row in (
        ("keypoints", f"{config}, float32, 2"),
        ("descriptors", f"{config}, {dtype}, 128, {name}, L2"),
    ):
        folder = (reconstruction / kind / "rootsift").rename(reconstruction / kind / name)
        (folder / f"{kind}.txt").write_text(f"# kapture format: 1.1\n# name\n{row}\n")
    observations = reconstruction / "observations.txt"
    observations.write_text(observations.read_text().replace("rootsift", name))
    keypoints = KaptureMap.open(map_copy).keypoints[name]
    found = keypoints.extractor()
    assert expected == (found and " ".join([found.name, *map(str, found.options.values())]))


def test_an_unknown_type_is_refused_with_the_known_ones_and_a_remedy(map_copy: Path) -> None:
    for kind in ("keypoints", "descriptors"):
        folder = map_copy / "reconstruction" / kind
        (folder / "rootsift").rename(folder / "D2-Net")
        table = folder / "D2-Net" / f"{kind}.txt"
        table.write_text(table.read_text().replace("rootsift", "D2-Net"))
    observations = map_copy / "reconstruction" / "observations.txt"
    observations.write_text(observations.read_text().replace("rootsift", "D2-Net"))
    opened = KaptureMap.open(map_copy)
    (local,) = local_types_of(opened, options_of_preset("classic"))
    with pytest.raises(DataError, match=r"'D2-Net'.*known: .*rootsift.*D2-Net/keypoints\.txt"):
        _ = local.extractor
