"""The stages one by one make what ``megloc eval`` makes; and import, evaluate and submit."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from megloc_kapture.cli.main import main
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.io.tables import read_match_counts

Contents = Callable[[Path], dict[str, bytes]]

OPTIONS = ("--set", "local_features.options.max_keypoints=800")
INLINE = ("--executor", "inline")


@dataclass(frozen=True)
class Made:
    """What the chain of single stages wrote."""

    features: Path
    vlad: Path
    mapping_pairs: Path
    query_pairs: Path
    mapping_matches: Path
    query_matches: Path
    map: Path


@pytest.fixture(scope="module")
def made(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Every stage up to the map and the matches of the queries, each by its own command; not to
    be written into."""
    root = tmp_path_factory.mktemp("made")
    made = Made(*(root / field.name for field in fields(Made)))
    mapping, query = scene / "mapping", scene / "query"
    local = ["--features-dir", made.features]
    both = [*local, "--features-dir", made.vlad]
    match = ["match", "-i", mapping, *local, *INLINE, "--pairs"]
    triangulate = ["triangulate", "-i", mapping, *both, "--features-dir", made.mapping_matches]
    for command in (
        ["extract-local", "-i", mapping, "-i", query, "-o", made.features, *OPTIONS, *INLINE],
        ["extract-global", "-i", mapping, "--query", query, "-o", made.vlad, *local, *INLINE],
        ["pairs-mapping", "-i", mapping, "-o", made.mapping_pairs, *both],
        ["pairs-query", "-i", mapping, "--query", query, "-o", made.query_pairs, *both],
        [*match, made.mapping_pairs, "-o", made.mapping_matches],
        [*match, made.query_pairs, "--query", query, "-o", made.query_matches],
        [*triangulate, "--pairs", made.mapping_pairs, "-o", made.map],
    ):
        with pytest.raises(SystemExit) as end, redirect_stderr(io.StringIO()) as told:
            main([*map(str, command), "--quiet"])
        assert (end.value.code, told.getvalue()) == (0, ""), command[0]
    return made


def test_stages_one_by_one_make_the_same_bytes(
    made: Made, finished: Path, contents: Contents
) -> None:
    def without_marks(folder: Path) -> dict[str, bytes]:
        return {n: c for n, c in contents(folder).items() if not n.endswith(".megloc")}

    expected = contents(finished)

    def part(*prefixes: str) -> dict[str, bytes]:
        return {n: c for n, c in expected.items() if n.startswith(prefixes)}

    assert without_marks(made.features) == part("local_features/")
    assert without_marks(made.vlad) == part("global_features/")
    assert made.mapping_pairs.read_bytes() == expected["pairs/mapping.txt"]
    assert made.query_pairs.read_bytes() == expected["pairs/query.txt"]
    for place, name in ((made.mapping_matches, "mapping"), (made.query_matches, "query")):
        prefix = f"matches/{name}/"
        found = without_marks(place)
        assert found and found == {n.removeprefix(prefix): c for n, c in part(prefix).items()}
    for name in ("points3d.txt", "observations.txt"):
        ours = (made.map / "reconstruction" / name).read_bytes()
        assert ours == expected[f"map/reconstruction/{name}"]


def test_and_the_map_they_make_is_one_to_localize_in(
    megloc: Any, made: Made, scene: Path, tmp_path: Path
) -> None:
    result = tmp_path / "localized"
    done = megloc(
        *("localize", "-i", made.map, "--query", scene / "query", "-o", result),
        *("--pairs", made.query_pairs, "--features-dir", made.features),
    )
    assert done.out.startswith("4 of 4"), done
    report = tmp_path / "evaluation"
    done = megloc("evaluate", "-i", result, "--gt", scene / "query_gt", "-o", report)
    assert done.status == 0 and "100.0 / 100.0 / 100.0 / 100.0" in done.out
    rows = json.loads((report / "recall.json").read_text())["rows"]
    assert rows[-1]["recall"][0]["recall"] == 1.0
    poses = tmp_path / "new" / "poses.txt"
    done = megloc("submit", "kapture", "-i", result, "-o", poses)
    assert done.out == f"4 poses of 4 queries: {poses}\n"
    assert poses.with_name("poses.txt.json").is_file()
    # the pose file is as good as the folder it comes from
    again = megloc("evaluate", "-i", poses, "--gt", scene / "query_gt")
    assert "100.0 / 100.0 / 100.0 / 100.0" in again.out
    megloc("submit", "kapture", "-i", result, "-o", poses).refused(r"poses\.txt exists; -f")
    assert megloc("submit", "kapture", "-i", result, "-o", poses, "-f").status == 0


def test_reranking_keeps_the_best_matched_and_their_matches(
    megloc: Any, made: Made, scene: Path, tmp_path: Path
) -> None:
    pairs, matches = tmp_path / "reranked.txt", tmp_path / "reranking"
    both = ["--features-dir", made.features, "--features-dir", made.vlad]
    command = ["pairs-query", "-i", scene / "mapping", "--query", scene / "query", "-o", pairs]
    by = ("--rerank", "2", "--rerank-by", "verified")
    done = megloc(*command, *both, *by, "--matches-dir", matches, *INLINE, "-q")
    assert (done.status, done.err) == (0, "")
    counted = read_match_counts(matches, "rootsift")
    counts = {(count.image, count.other): count.verified for count in counted}
    # all candidates were matched, and the matches are those that a later step makes
    assert counts.keys() == {(pair.query, pair.map) for pair in read_pairs(made.query_pairs)}
    kept = read_pairs(pairs)
    for query in {pair.query for pair in kept}:
        best = sorted((n for (q, _), n in counts.items() if q == query), reverse=True)[:2]
        assert [counts[pair.query, pair.map] for pair in kept if pair.query == query] == best
    found, again = (
        KaptureFolder(scene / "query", features_dirs=[folder]).matches("rootsift")
        for folder in (matches, made.query_matches)
    )
    for pair in ((pair.query, pair.map) for pair in kept):
        np.testing.assert_array_equal(found.read(*pair)[0], again.read(*pair)[0])
    refused = megloc(*command, *both, "--rerank", "2", "-f")
    refused.refused("--rerank N and --matches-dir DIR go together")
    megloc(*command, *both).refused(r"reranked\.txt exists; -f")


def test_several_global_features_are_fused(
    megloc: Any, made: Made, scene: Path, tmp_path: Path
) -> None:
    soft = tmp_path / "soft"
    features = ["--features-dir", made.features]
    done = megloc(
        *("extract-global", "-i", scene / "mapping", "--query", scene / "query", "-o", soft),
        *(*features, *INLINE, "--set", "global_features.options.assignment=soft", "-q"),
    )
    assert (done.status, done.err) == (0, "")
    # the same vectors under a second name
    second = soft / "global_features" / "second"
    (soft / "global_features" / "vlad_rootsift").rename(second)
    folders = ["--features-dir", made.vlad, "--features-dir", soft]
    command = ["pairs-query", "-i", scene / "mapping", "--query", scene / "query"]
    megloc(*command, "-o", tmp_path / "none.txt", *folders).refused(
        "several types of global_features, name one: second, vlad_rootsift"
    )
    found = {}
    for name, arguments in {
        "hard": ["--features", "vlad_rootsift"],
        "both": ["--features", "vlad_rootsift", "second", "--fusion", "mean"],
        "soft": ["--features", "second"],
    }.items():
        out = tmp_path / f"{name}.txt"
        done = megloc(*command, "-o", out, *folders, *arguments, "-q")
        assert (done.status, done.err) == (0, "")
        found[name] = {(pair.query, pair.map): pair.score for pair in read_pairs(out)}
    assert found["hard"] != found["soft"]
    for pair, score in found["both"].items():
        assert score == pytest.approx((found["hard"][pair] + found["soft"][pair]) / 2, abs=1e-6)


@pytest.mark.parametrize(
    "command",
    ["densify", "refine-map", "refine-poses", "triangulate", "pairs-mapping", "pairs-query"],
)
def test_a_scheduler_that_nothing_asks_is_refused(
    megloc: Any, finished: Path, tmp_path: Path, command: str
) -> None:
    out, query = tmp_path / "out", ("--query", finished / "query")
    given: tuple[Any, ...] = (command, "-i", finished / "map", "-o", out)
    if command == "refine-poses":
        given += (*query, "--poses", finished / "localized", "--by", "icp")
    if command == "pairs-query":
        given += (*query, "--exhaustive")
    if command == "pairs-mapping":
        given += ("--by", "poses")
    if command == "triangulate":
        given += ("--features-dir", finished / "matches" / "mapping")
    megloc(*given, "--scheduler", "tcp://127.0.0.1:1").refused("--scheduler needs --executor dask")
    assert not out.exists()
    if command in ("pairs-query", "pairs-mapping"):
        assert megloc(*given, "--workers", "2").status == 0
        assert megloc(*given[:-1], given[-1], "-f", "--workers", "0").status == 2


def test_output_of_another_kind_is_refused(
    megloc: Any, made: Made, scene: Path, tmp_path: Path
) -> None:
    # features where a map is
    command = ["extract-local", "-i", scene / "query", "-o", made.map, *OPTIONS, *INLINE]
    megloc(*command, "-q").refused(f"{made.map}: is not empty and not a features of megloc")
    # more features beside ours
    command[4] = shutil.copytree(made.vlad, tmp_path / "vlad")
    assert megloc(*command, "-q").status == 0
    assert KaptureFolder(scene / "query", features_dirs=[tmp_path / "vlad"]).types("keypoints")


def test_what_cannot_be_extracted_is_refused(megloc: Any, scene: Path, tmp_path: Path) -> None:
    described = ["extract-global", "-i", scene / "mapping", "-o", tmp_path / "out"]
    megloc(*described, "--features", "nothing").refused(
        "unknown global features 'nothing'; known: vlad, apgem, delg"
    )
    command = ["extract-local", "-i", scene / "query", "-i", scene / "query"]
    done = megloc(*command, "-o", tmp_path / "features", "-q")
    done.refused(r"image 0001\.jpg is in two kapture folders")
    assert list(tmp_path.iterdir()) == []


def test_ways_to_pair(megloc: Any, finished: Path, tmp_path: Path) -> None:
    mapping, points, pairs = finished / "mapping", finished / "map", tmp_path / "pairs.txt"
    command = ("pairs-mapping", "-i", mapping, "-o", pairs, "--by")

    def count(*arguments: str | Path) -> int:
        done = megloc(*command, *arguments, "-f", "-q")
        assert done.status == 0, done.err
        return len(read_pairs(pairs))

    assert count("exhaustive") == 21
    one = ("--topk", "1", "--features-dir", finished)
    nearest = count("retrieval", *one)
    assert 4 <= nearest <= 7
    assert nearest <= count("retrieval", "poses", *one) <= 21
    # the images stand in the order in which they were taken
    window = ("--set", "mapping_pairs.sequence.window=1")
    assert count("sequence", *window) == 6
    assert count("sequence", *window, "--set", "mapping_pairs.sequence.loop=true") == 7
    shared = count("covisibility", "--covisibility-map", points)
    assert 0 < shared <= 21
    both = count("covisibility", "sequence", "--covisibility-map", points)
    assert max(shared, 6) <= both <= 21
    own = megloc("pairs-mapping", "-i", points, "-o", pairs, "--by", "covisibility", "-f")
    assert own.err == f"{shared} pairs\n"
    for arguments, words in (
        (("covisibility", "-f"), "mapping: co-visibility needs a map's points"),
        (("sequence", "--covisibility-map", points, "-f"), "--covisibility-map is for --by covis"),
        (("exhaustive",), r"pairs\.txt exists; -f overwrites it"),
        (("retrieval", "-f"), "mapping: no global_features; give their folder with --features-dir"),
    ):
        megloc(*command, *arguments).refused(words)
    query = ["pairs-query", "-i", mapping, "--query", finished / "query", "--exhaustive", "-q"]
    assert megloc(*query, "-o", tmp_path / "query.txt").status == 0
    assert len(read_pairs(tmp_path / "query.txt")) == 28


def test_a_map_of_two_types_of_features(megloc: Any, scene: Path, tmp_path: Path) -> None:
    features, mapping, pairs = tmp_path / "features", scene / "mapping", tmp_path / "pairs.txt"
    place = ("-i", mapping, "--features-dir", features)
    few = ("--set", "local_features.rootsift.options.max_keypoints=500")
    few += ("--set", "local_features.sift.options.first_octave=0")
    both = ("--features", "rootsift", "sift")
    match = ["match", *place, "--pairs", pairs, "-o", features, *INLINE, "--features"]
    commands = [
        ["extract-local", "-i", mapping, "-o", features, *both, *few, *INLINE],
        ["pairs-mapping", "-i", mapping, "-o", pairs, "--by", "sequence"],
        *([*match, name] for name in ("rootsift", "sift")),
    ]
    for command in commands:
        done = megloc(*command, "-q")
        assert done.status == 0, done
    megloc("triangulate", *place, "-o", tmp_path / "map").refused("several types of matches")
    done = megloc("triangulate", *place, "-o", tmp_path / "map", *both)
    lines = [line.split() for line in done.err.splitlines()][-3:]
    assert [line[0] for line in lines[:2]] == ["rootsift:", "sift:"]
    folder = KaptureFolder(tmp_path / "map")
    folder.validate()
    found = folder.observations()
    assert [int(line[3]) for line in lines[:2]] == [len(found["rootsift"]), len(found["sift"])]
    assert min(len(seen) for seen in found.values()) > 100
    assert int(lines[2][0]) == len(folder.points3d())


def test_what_cannot_be_matched_is_refused(megloc: Any, workspace: Path, tmp_path: Path) -> None:
    pairs, output = tmp_path / "pairs.txt", ("-o", tmp_path / "new", *INLINE)
    pairs.write_text("0000.jpg, 0002.jpg, 1.0\n0000.jpg, 0001.jpg, 1.0\n")
    command = ["match", "-i", workspace / "mapping", "--features-dir", workspace, *output]
    message = r"pairs\.txt: no image 0001\.jpg in .*/mapping"
    megloc(*command, "--pairs", pairs).refused(message)
    spoilt = workspace / "local_features/rootsift/descriptors/0002.jpg.desc"
    content = spoilt.read_bytes()
    spoilt.unlink()  # a map may have it by another name
    spoilt.write_bytes(content[:-512])
    done = megloc(*command, "--pairs", workspace / "pairs/mapping.txt")
    done.refused(f"{spoilt}: 799 descriptors for 800 keypoints")
    assert not (tmp_path / "new").exists()


def test_import_links_images_and_prefixes_queries(megloc: Any, scene: Path, tmp_path: Path) -> None:
    done = megloc("import", "kapture", scene, "-o", tmp_path / "in", "--query-prefix", "q/")
    counts = dict(line.rsplit(maxsplit=1) for line in done.out.splitlines())
    expected = {"map images": "7", "map images with pose": "7", "queries": "4"}
    assert counts == expected | {"queries with truth": "4"}
    query = KaptureFolder(tmp_path / "in" / "query")
    assert query.read().image_names()[0] == "q/0001.jpg"
    original = scene / "query/sensors/records_data/0001.jpg"
    assert query.image_path("q/0001.jpg").read_bytes() == original.read_bytes()
    megloc("import", "venice", scene, "-o", tmp_path / "x").refused("unknown dataset 'venice'")


def test_networks_compute_where_the_flags_say(
    megloc: Any, shared_data: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))
    mapping, features = scene / "mapping", tmp_path / "features"
    extract = ["extract-local", "-i", mapping, *INLINE]
    half = [*extract, "--features", "xfeat", "-o", features, "--precision", "half"]
    assert megloc(*half, "--device", "cpu").status == 0
    full = [*extract, "--features", "xfeat", "-o", tmp_path / "full"]
    assert megloc(*full).status == 0
    name = f"local_features/xfeat/keypoints/{KaptureFolder(mapping).read().image_names()[0]}.kpt"
    both = [(place / name).read_bytes() for place in (features, tmp_path / "full")]
    assert both[0] != both[1]
    run = ["eval", "kapture", "--root", scene, "-w", tmp_path / "run", "-q", "--dry-run"]
    megloc(*run, "--preset", "modern", "--device", "gpu").refused("option device: String should")
    if not torch.cuda.is_available():
        megloc(*full, "-f", "--device", "cuda:1").refused("device=cuda:1: this machine has no GPU")
