"""kapture-localization's tools through our adapter, on data that they made themselves."""

from __future__ import annotations

from pathlib import Path

import pytest
from kloc import kloc, merged, needs_kapture_localization, pose_errors

pytestmark = pytest.mark.slow


@needs_kapture_localization
def test_kapture_localization_localizes_in_its_own_map(shared_data: Path, tmp_path: Path) -> None:
    scene = shared_data / "foreign_maps" / "virtual_gallery"
    pairs, result = tmp_path / "pairs.txt", tmp_path / "localized"
    both = ["--mapping", scene / "map", "--query", scene / "query"]
    kloc("kapture_compute_image_pairs", *both, "--topk", "5", "-o", pairs)
    everything = merged(tmp_path / "all", scene / "map", scene / "query")
    kloc("kapture_compute_matches", "-i", everything, "--pairsfile-path", pairs)
    kloc(
        "kapture_pycolmap_localize",
        *("-i", everything, "--query", scene / "query", "--pairsfile-path", pairs, "-o", result),
        "--write-detailed-report",
    )
    errors = pose_errors(result, scene / "query_gt")
    assert len(errors) == 4
    # 0.023 m and 0.35 deg at worst with the environment it was written for
    assert all(metres < 0.03 and degrees < 0.5 for metres, degrees in errors.values()), errors
