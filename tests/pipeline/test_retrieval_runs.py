"""Several global features, fused, and reranking, in whole runs and from Python."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import read_pairs
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.nets.global_descriptors import VggNetVlad
from megloc_kapture.pipeline.plan import Workspace
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.queries import Query
from megloc_kapture.stages.options import PipelineOptions
from tests.pipeline.runs import evaluated, recall

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> PipelineOptions:
    """VLAD and a network of random weights, which ranks at random, of small images."""
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("weights") / "random.pth"
    net = VggNetVlad(order="kd", mean_rgb=(0, 0, 0), num_clusters=2, output_size=32)
    for layer in net.modules():  # with torch's own scale all images have the same vector
        if isinstance(layer, torch.nn.Conv2d):
            torch.nn.init.kaiming_normal_(layer.weight)
    torch.save(net.state_dict(), file)
    return options_of_preset(
        assignments=[
            "local_features.options.max_keypoints=500",
            "preprocessing.max_size_px=400",
            'global_features=["vlad","openibl"]',
            f"global_features.openibl.options.weights={file}",
            "global_features.vlad.options.num_clusters=8",
            "global_features.vlad.options.dimensions=6",
            "global_features.vlad.weight=3",
            "query_pairs.top_k=5",
            "reranking.by=coverage",
            "reranking.keep=3",
        ]
    )


@pytest.fixture(scope="module")
def finished(
    fountain: Path, options: PipelineOptions, tmp_path_factory: pytest.TempPathFactory
) -> Workspace:
    return evaluated(tmp_path_factory.mktemp("fused") / "workspace", fountain, options)


def test_all_candidates_are_matched_once_and_the_best_are_localized_with(
    finished: Workspace,
) -> None:
    assert recall(finished)[1] == 1
    candidates = read_pairs(finished.path("pairs/query_candidates.txt"))
    kept = read_pairs(finished.path("pairs/query.txt"))
    counted = read_match_counts(finished.path("matches/query"), "rootsift")
    assert len(candidates) == 4 * 5 and len(kept) == 4 * 3
    assert {(c.image, c.other) for c in counted} == {(p.query, p.map) for p in candidates}
    assert {(p.query, p.map) for p in kept} < {(p.query, p.map) for p in candidates}
    assert not finished.path("matches/query_candidates").exists()
    types = finished.folder("mapping", "").types("global_features")
    assert types == ["openibl-random", "vlad_rootsift"]


def test_vectors_that_the_map_lacks_are_made_from_its_images(
    finished: Workspace, options: PipelineOptions, tmp_path: Path
) -> None:
    only = options.model_copy(update={"global_features": options.global_features[1:]})
    bare = Path(shutil.copytree(finished.path("map"), tmp_path / "map", symlinks=True))
    shutil.rmtree(bare / "reconstruction" / "global_features" / "openibl-random")
    opened = KaptureMap.open(bare)
    assert opened.global_types() == ["vlad_rootsift"]
    localizer = Localizer(opened, options=only)
    for image in opened.images:
        # a map image is most like itself
        query = Query(opened.camera(image), opened.folder.image_path(image), "query")
        assert localizer.ranked(query)[0] == image


def test_all_missing_weights_are_told_at_once(fountain: Path, tmp_path: Path) -> None:
    root = tmp_path / "workspace"
    with pytest.raises(MissingWeightsError) as caught:
        evaluated(root, fountain, options_of_preset("megloc"))
    *said, together = str(caught.value).splitlines()
    assert len(said) == len(set(said)) == 7
    assert "megloc weights fetch --preset megloc" in together
    for name in ("superpoint_v1", "superglue", "aslfeat", "netvlad", "delg", "apgem", "openibl"):
        assert any(name in line for line in said), name
    assert not root.exists()


def test_vectors_that_cannot_be_are_refused(fountain: Path, tmp_path: Path) -> None:
    twice = options_of_preset(assignments=['global_features=["vlad","vlad"]'])
    with pytest.raises(OptionError, match="global features 'vlad_rootsift' are asked for twice"):
        evaluated(tmp_path / "workspace", fountain, twice)
    wrong = options_of_preset(assignments=["global_features.options.num_clusters=0"])
    with pytest.raises(OptionError, match="'vlad' refuse their options: num_clusters"):
        wrong.retrieval()
