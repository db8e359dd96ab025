"""kapture's and kapture-localization's tools on our data, and our stages on theirs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir
from kloc import kapture_tool, kloc, merged, needs_kapture_localization, pose_errors, proxy

from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.stages.image_pairs import QueryPairsOptions, Retrieval, pair_queries
from megloc_kapture.stages.localized_folder import write_localized
from megloc_kapture.stages.map_points import triangulate_map
from megloc_kapture.stages.query_poses import LocalizationOptions, localize_from_matches

pytestmark = pytest.mark.slow

LOCAL, GLOBAL = "rootsift", "vlad_rootsift"


def assert_all_localized(result: Path, truth: Path) -> None:
    errors = pose_errors(result, truth)
    assert len(errors) == 4
    assert all(metres < 0.05 and degrees < 5 for metres, degrees in errors.values()), errors


@pytest.fixture(scope="module")
def theirs(
    fountain: Path, fountain_workspace: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Pairs and matches by kapture-localization from the workspace's features.

    ``together`` is a kapture of links with the map, its points and the queries; the matches are
    in separate features folders (orphan layout).
    """
    folder = tmp_path_factory.mktemp("kapture_localization")
    features = fountain_workspace / "local_features" / LOCAL
    vlad = fountain_workspace / "global_features" / GLOBAL / "global_features"

    def linked(name: str, sensors_of: Path) -> Path:
        matches = folder / f"{name}_matches" / "local_features" / LOCAL / "matches"
        matches.mkdir(parents=True)
        data = {
            f"keypoints/{LOCAL}": features / "keypoints",
            f"descriptors/{LOCAL}": features / "descriptors",
            f"global_features/{GLOBAL}": vlad,
            f"matches/{LOCAL}": matches,
        }
        return proxy(folder / name, sensors_of, data)

    mapping, query = linked("mapping", fountain / "mapping"), linked("query", fountain / "query")
    data = ["keypoints", "descriptors", "global_features", "matches"]
    sensors = merged(folder / "merged", fountain / "mapping", fountain / "query", skip=data)
    together = linked("together", sensors)
    for points in ("points3d.txt", "observations.txt"):
        ours = fountain_workspace / "map" / "reconstruction" / points
        (together / "reconstruction" / points).symlink_to(ours)

    for image_set, matched in ((mapping, mapping), (query, together)):
        pairs = folder / f"{image_set.name}_pairs.txt"
        both = ["--mapping", mapping, "--query", image_set]
        kloc("kapture_compute_image_pairs", *both, "--topk", "7", "-o", pairs)
        kloc("kapture_compute_matches", "-i", matched, "--pairsfile-path", pairs)
    return folder


@needs_kapture_localization
def test_pairs_of_both_agree(theirs: Path, fountain_workspace: Path) -> None:
    by_query: dict[str, list[str]] = {}
    for pair in read_pairs(theirs / "query_pairs.txt"):
        by_query.setdefault(pair.query, []).append(pair.map)
    ours: dict[str, list[str]] = {}
    for pair in read_pairs(fountain_workspace / "pairs" / "query.txt"):
        ours.setdefault(pair.query, []).append(pair.map)
    assert by_query == ours


@needs_kapture_localization
def test_kapture_localization_localizes_in_our_map(
    theirs: Path, fountain: Path, tmp_path: Path
) -> None:
    result = tmp_path / "localized"
    places = ["-i", theirs / "together", "--query", fountain / "query", "-o", result]
    kloc("kapture_pycolmap_localize", *places, "--pairsfile-path", theirs / "query_pairs.txt")
    assert_all_localized(result, fountain / "query_gt")


@needs_kapture_localization
def test_our_stages_run_on_pairs_and_matches_of_kapture_localization(
    theirs: Path, fountain: Path, fountain_workspace: Path, tmp_path: Path
) -> None:
    # these matches are mutual nearest neighbours without verification
    places = [fountain_workspace, theirs / "mapping_matches"]
    mapping = KaptureFolder(fountain / "mapping", features_dirs=places)
    assert len(mapping.matches(LOCAL).pairs) == 21  # all pairs of 7 images
    our_map, result = tmp_path / "map", tmp_path / "localized"
    counts = triangulate_map(mapping, [LOCAL], our_map, TriangulationOptions())
    assert counts["points"] > 1000
    options = LocalizationOptions()
    pairs = read_pairs(theirs / "query_pairs.txt")
    places = [fountain_workspace, theirs / "together_matches"]
    query = KaptureFolder(fountain / "query", features_dirs=places)
    actual = localize_from_matches(KaptureFolder(our_map), query, pairs, [LOCAL], options)
    write_localized(result, query, actual)
    assert_all_localized(result, fountain / "query_gt")


@needs_kapture_localization
def test_ap_gem_gives_the_pairs_and_scores_of_kapture_localization(
    shared_data: Path, tmp_path: Path
) -> None:
    top_k = 50
    scene = shared_data / "foreign_maps" / "virtual_gallery"
    both = ["--mapping", scene / "map", "--query", scene / "query"]
    path = tmp_path / "pairs.txt"
    how = ("-gfeat", "AP-GeM-LM18", "--topk", str(top_k), "-o", path)
    kloc("kapture_compute_image_pairs", *both, *how)
    theirs = read_pairs(path)
    mapping, query = KaptureFolder(scene / "map"), KaptureFolder(scene / "query")
    options = QueryPairsOptions(top_k=top_k)
    ours = pair_queries(mapping, query, options, retrieval=Retrieval(("AP-GeM-LM18",)))
    assert len(theirs) >= 12
    assert [(p.query, p.map) for p in ours] == [(p.query, p.map) for p in theirs]
    assert [p.score for p in ours] == pytest.approx([p.score for p in theirs], rel=0, abs=1e-6)


def test_kaptures_colmap_export_reads_our_map(fountain_workspace: Path, tmp_path: Path) -> None:
    ours = fountain_workspace / "map"
    database, model = tmp_path / "colmap.db", tmp_path / "model"
    kapture_tool(
        "kapture_export_colmap", "-i", ours, "-db", database, "-txt", model, "-kpt", "rootsift"
    )
    lines = (model / "points3D.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    points = KaptureFolder(ours).points3d()
    assert len(rows) == len(points) > 500
    exported = np.array([row[1:4] for row in rows], dtype=np.float64)
    order = np.argsort([int(row[0]) for row in rows])
    np.testing.assert_allclose(exported[order], points[:, :3], atol=1e-6)
    observed = sum((len(row) - 8) // 2 for row in rows)
    assert observed == len(KaptureFolder(ours).observations()["rootsift"].point_ids)


def test_kapture_reads_the_whole_workspace(fountain_workspace: Path) -> None:
    for part, images in (("mapping", 7), ("query", 4), ("map", 7), ("localized", 4)):
        data = kapture_from_dir(str(fountain_workspace / part))
        assert len(data.records_camera.data_list()) == images, part
