"""The stages as single commands, preprocessing too, followed by localize and submit."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.cli.main import main
from megloc_kapture.cli.stages import Preprocess
from megloc_kapture.errors import OptionError
from megloc_kapture.io.images import image_size, read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.preprocessing.masks import FixedMask
from tests.worlds import folder_bytes

OPTIONS = ("--set", "local_features.options.max_keypoints=800")
INLINE = ("--executor", "inline")


@pytest.fixture(scope="module")
def made(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outputs of every stage up to the map and the matches of queries; read only."""
    made = tmp_path_factory.mktemp("made")
    mapping, query = scene / "mapping", scene / "query"
    local = ["--features-dir", made / "features"]
    both = [*local, "--features-dir", made / "vlad"]
    match = ["match", "-i", mapping, *local, *INLINE, "--pairs"]
    triangulate = ["triangulate", "-i", mapping, *both, "--features-dir", made / "mapping_matches"]
    for command in (
        ["extract-local", "-i", mapping, "-i", query, "-o", made / "features", *OPTIONS, *INLINE],
        ["extract-global", "-i", mapping, "--query", query, "-o", made / "vlad", *local, *INLINE],
        ["pairs-mapping", "-i", mapping, "-o", made / "mapping_pairs", *both],
        ["pairs-query", "-i", mapping, "--query", query, "-o", made / "query_pairs", *both],
        [*match, made / "mapping_pairs", "-o", made / "mapping_matches"],
        [*match, made / "query_pairs", "--query", query, "-o", made / "query_matches"],
        [*triangulate, "--pairs", made / "mapping_pairs", "-o", made / "map"],
    ):
        with pytest.raises(SystemExit) as end, redirect_stderr(io.StringIO()) as err:
            main([*map(str, command), "--quiet"])
        assert (end.value.code, err.getvalue()) == (0, ""), command[0]
    return made


def test_single_stages_write_the_same_files_as_eval(made: Path, finished: Path) -> None:
    def without_marks(folder: Path) -> dict[str, bytes]:
        return {n: c for n, c in folder_bytes(folder).items() if not n.endswith(".megloc")}

    expected = folder_bytes(finished)

    def part(*prefixes: str) -> dict[str, bytes]:
        return {n: c for n, c in expected.items() if n.startswith(prefixes)}

    assert without_marks(made / "features") == part("local_features/")
    assert without_marks(made / "vlad") == part("global_features/")
    assert (made / "mapping_pairs").read_bytes() == expected["pairs/mapping.txt"]
    assert (made / "query_pairs").read_bytes() == expected["pairs/query.txt"]
    for place, name in ((made / "mapping_matches", "mapping"), (made / "query_matches", "query")):
        prefix = f"matches/{name}/"
        actual = without_marks(place)
        assert actual and actual == {n.removeprefix(prefix): c for n, c in part(prefix).items()}
    for name in ("points3d.txt", "observations.txt"):
        ours = (made / "map" / "reconstruction" / name).read_bytes()
        assert ours == expected[f"map/reconstruction/{name}"]


def test_the_map_of_single_stages_is_localized_in_evaluated_and_submitted(
    megloc: Any, made: Path, scene: Path, tmp_path: Path
) -> None:
    result = tmp_path / "localized"
    done = megloc(
        *("localize", "-i", made / "map", "--query", scene / "query", "-o", result),
        *("--pairs", made / "query_pairs", "--features-dir", made / "features"),
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
    # the pose file gives the same recall as the folder
    again = megloc("evaluate", "-i", poses, "--gt", scene / "query_gt")
    assert "100.0 / 100.0 / 100.0 / 100.0" in again.out
    megloc("submit", "kapture", "-i", result, "-o", poses).refused(r"poses\.txt: exists; -f")
    assert megloc("submit", "kapture", "-i", result, "-o", poses, "-f").status == 0


def test_reranked_pairs_and_their_matches_are_written(
    megloc: Any, made: Path, scene: Path, tmp_path: Path
) -> None:
    pairs, matches = tmp_path / "reranked.txt", tmp_path / "reranking"
    folders = ("--features-dir", made / "features", "--features-dir", made / "vlad")
    queries = ("-i", scene / "mapping", "--query", scene / "query", "-o", pairs)
    command = ("pairs-query", *queries, *folders, "--rerank", "2", "--rerank-by", "verified")
    assert megloc(*command, "--matches-dir", matches, *INLINE, "-q").status == 0
    counts = read_match_counts(matches, "rootsift").keys()
    assert counts == {(pair.query, pair.map) for pair in read_pairs(made / "query_pairs")}
    assert len(read_pairs(pairs)) == 2 * 4
    megloc(*command, "-f").refused("--rerank N needs --matches-dir DIR")
    megloc(*command, "--matches-dir", matches).refused(r"reranked\.txt: exists; -f")


@pytest.mark.parametrize(
    ("by", "part", "message"),
    [
        ("covisibility", "mapping", "mapping: no map to pair images by co-visibility"),
        ("retrieval", "mapping", "no global_features; --features-dir FOLDER adds those in FOLDER/"),
        ("poses", "query", "query: pairs by poses: no image has a pose"),
    ],
)
def test_pairs_without_their_inputs_are_refused(
    megloc: Any, finished: Path, tmp_path: Path, by: str, part: str, message: str
) -> None:
    command = ("pairs-mapping", "-i", finished / part, "-o", tmp_path / "pairs.txt")
    megloc(*command, "--by", by).refused(message)


def test_pairs_of_unknown_images_are_refused(megloc: Any, finished: Path, tmp_path: Path) -> None:
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0000.jpg, 0002.jpg, 1.0\n0000.jpg, 0001.jpg, 1.0\n")
    places = ("-i", finished / "mapping", "--features-dir", finished, "-o", tmp_path / "new")
    message = r"pairs\.txt: no image 0001\.jpg in .*/mapping"
    megloc("match", *places, "--pairs", pairs, *INLINE).refused(message)
    message = "pairs.txt: no such features folder"
    megloc("match", *places, "--features-dir", pairs, "--pairs", pairs).refused(message)
    assert not (tmp_path / "new").exists()


def test_pairs_of_images_without_poses_need_a_two_view_verification(
    megloc: Any, made: Path, scene: Path, tmp_path: Path
) -> None:
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0001.jpg, 0004.jpg, 1.0\n")
    command = ("match", "-i", scene / "query", "--features-dir", made / "features", *INLINE)
    command += ("--pairs", pairs, "-o", tmp_path / "matches")
    megloc(*command).refused(
        "1 of 1 pairs in .*pairs.txt have an image without a pose .* --query FOLDER"
    )
    assert "in 1 pairs" in megloc(*command, "--query", scene / "query").err


def test_device_and_precision_of_networks_are_chosen_by_flags(
    megloc: Any, shared_data: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))
    command = ("extract-local", "-i", scene / "query", *INLINE, "--features", "xfeat", "-o")
    assert megloc(*command, tmp_path / "full", "--device", "cpu").status == 0
    assert megloc(*command, tmp_path / "half", "--precision", "half").status == 0
    name = "local_features/xfeat/keypoints/0001.jpg.kpt"
    full, half = ((tmp_path / place / name).read_bytes() for place in ("full", "half"))
    assert full != half
    run = ["eval", "kapture", "--root", scene, "-w", tmp_path / "run", "-q", "--dry-run"]
    megloc(*run, "--preset", "modern", "--device", "gpu").refused("option device: String should")
    alone = ("preprocess", "-i", scene / "query", "-o", tmp_path / "new", "--device", "gpu")
    megloc(*alone).refused("option device: String should")


@pytest.fixture
def camera(scene: Path) -> str:
    return KaptureFolder(scene / "query").read().record_of("0001.jpg")[1]


def flags(*arguments: str) -> Preprocess:
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
    # the names of other stages, too
    again = flags("--undistort", "--set", "preprocessing.upscale=true").options()
    assert (again.undistort, again.upscale) == (True, True)
    with pytest.raises(OptionError, match="^unknown option upscal; "):
        flags("--set", "upscal=true").options()


def test_images_are_resized_and_masked(
    megloc: Any, scene: Path, camera: str, tmp_path: Path
) -> None:
    before = folder_bytes(scene / "query")
    out = tmp_path / "new"
    small = ("preprocess", "-i", scene / "query", "-o", out, "--resize", "200", *INLINE)
    done = megloc(*small, "--bottom-share", f"{camera}=0.25")
    assert done.status == 0, done.err
    assert folder_bytes(scene / "query") == before
    assert "4 images, 4 of them changed" in done.err
    assert "masked (fixed): 22.22 % of all pixels" in done.err
    new = KaptureFolder(out)
    new.validate(deep=True)
    image = "0001.jpg"
    assert image_size(new.image_path(image)) == (200, 144)
    mask = read_image_rgb(out / "sensors" / "masks" / f"{image}.png")[..., 0]
    assert mask.shape == (144, 200)
    assert set(np.unique(mask)) == {0, 255} and (mask[-30:] == 0).all()

    # a second run without the mask leaves no mask of the first
    assert megloc(*small).status == 0
    assert not (out / "sensors" / "masks").exists()
    assert [p.name for p in sorted(out.iterdir())] == [".megloc", "sensors"]
