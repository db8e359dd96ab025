"""Descriptors of maps that have none, and extractors by the names of types."""

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
    """Return descriptors of the map by RootSIFT with the given options."""
    extractor = RootSift(RootSiftOptions(**options))  # type: ignore[arg-type]
    return extract_again(opened, opened.keypoints["rootsift"], extractor)


def test_descriptors_are_extracted_again(workspace: Path, stripped: KaptureMap) -> None:
    original = KaptureMap.open(workspace / "map")
    found = again(stripped, max_keypoints=400)
    assert sorted(found) == original.images
    for image, descriptors in found.items():
        known = descriptors.any(axis=1)
        assert 300 < known.sum() <= 400
        stored = original.keypoints["rootsift"].descriptors(image)
        np.testing.assert_array_equal(descriptors[known], stored[known])


def test_a_map_of_another_extractor_or_without_images_is_refused(stripped: KaptureMap) -> None:
    with pytest.raises(DataError, match=r"finds only \d+ of \d+ observed keypoints"):
        again(stripped, contrast_threshold=0.2)
    (stripped.folder.root / "sensors" / "records_data").unlink()
    with pytest.raises(DataError, match="no descriptors of type 'rootsift', and no images"):
        again(KaptureMap.open(stripped.folder.root))


def rename_type(root: Path, name: str, keypoints: str, descriptors: str) -> None:
    """Rename the type of a map and write the configurations of its features."""
    reconstruction = root / "reconstruction"
    for kind, row in (("keypoints", keypoints), ("descriptors", descriptors)):
        folder = (reconstruction / kind / "rootsift").rename(reconstruction / kind / name)
        (folder / f"{kind}.txt").write_text(f"# kapture format: 1.1\n# name\n{row}\n")
    observations = reconstruction / "observations.txt"
    observations.write_text(observations.read_text().replace("rootsift", name))


@pytest.mark.parametrize(
    ("name", "config", "dtype", "expected"),
    [
        ("SIFT", "SIFT", "uint8", "sift"),
        ("sift", "sift", "float32", "rootsift"),
        ("sift_8192", "x", "uint8", "sift"),
        ("SuperPoint-v1", "x", "float32", "superpoint superpoint_v1"),
        ("ALIKED_N16ROT", "x", "float32", "aliked aliked-n16rot"),
        ("r2d2_500", "x", "float32", "r2d2"),
        ("R2D2-WASF-N16", "x", "float32", "r2d2 r2d2_WASF_N16"),
        ("mine", "Aliked", "float32", "aliked"),
        ("D2-Net", "d2net", "float32", None),
        ("orb_800", "x", "uint8", None),
    ],
)
def test_extractors_are_recognised_by_names_of_other_tools(
    name: str, config: str, dtype: str, expected: str | None, map_copy: Path
) -> None:
    rename_type(map_copy, name, f"{config}, float32, 2", f"{config}, {dtype}, 128, {name}, L2")
    keypoints = KaptureMap.open(map_copy).keypoints[name]
    found = keypoints.extractor()
    assert expected == (found and " ".join([found.name, *map(str, found.options.values())]))


def test_an_unknown_type_is_refused_with_the_remedy(map_copy: Path) -> None:
    rename_type(map_copy, "D2-Net", "d2net, float32, 2", "d2net, float32, 128, D2-Net, L2")
    (local,) = local_types_of(KaptureMap.open(map_copy), options_of_preset("classic"))
    with pytest.raises(DataError, match=r"'D2-Net'.*known: .*rootsift.*D2-Net/keypoints\.txt"):
        _ = local.extractor
