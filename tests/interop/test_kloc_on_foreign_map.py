"""kapture-localization's tools and our stages on kapture-localization's data."""

from __future__ import annotations

from pathlib import Path

import pytest
from kloc import kloc, merged, needs_kapture_localization, pose_errors

from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.stages.image_pairs import QueryPairsOptions, Retrieval, pair_queries

pytestmark = [needs_kapture_localization, pytest.mark.slow]

TYPE = "AP-GeM-LM18"


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


def test_ap_gem_gives_the_pairs_and_scores_of_kapture_localization(
    shared_data: Path, tmp_path: Path
) -> None:
    top_k = 50
    scene = shared_data / "foreign_maps" / "virtual_gallery"
    both = ["--mapping", scene / "map", "--query", scene / "query"]
    path = tmp_path / "pairs.txt"
    kloc("kapture_compute_image_pairs", *both, "-gfeat", TYPE, "--topk", str(top_k), "-o", path)
    theirs = read_pairs(path)
    mapping, query = KaptureFolder(scene / "map"), KaptureFolder(scene / "query")
    options = QueryPairsOptions(top_k=top_k)
    ours = pair_queries(mapping, query, options, retrieval=Retrieval((TYPE,)))
    assert len(theirs) >= 12
    assert [(p.query, p.map) for p in ours] == [(p.query, p.map) for p in theirs]
    assert [p.score for p in ours] == pytest.approx([p.score for p in theirs], rel=0, abs=1e-6)
