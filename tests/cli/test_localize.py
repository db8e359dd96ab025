"""``megloc localize`` and ``megloc info``: queries into a map of any tool, which stays as it is."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import (
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    write_pairs,
    write_sensors,
)
from megloc_kapture.io.tables import read_status

IMAGES = "training/gallery_light1_loop1/frames/rgb/camera_0/rgb_00"


def medians(result: Path, truth: Path) -> tuple[float, float, float]:
    """Share of localized queries, and their median errors in metres and degrees."""
    row = evaluate(result, truth).row()
    assert row.median_position_m is not None and row.median_angle_deg is not None
    return row.num_localized / row.num_queries, row.median_position_m, row.median_angle_deg


def state(root: Path) -> dict[str, tuple[str, int]]:
    """SHA-256 and time of change of every file."""
    return {
        str(path.relative_to(root)): (
            hashlib.sha256(path.read_bytes()).hexdigest(),
            path.stat().st_mtime_ns,
        )
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def foreign(finished: Path, scene: Path, tmp_path: Path) -> Path:
    """A map and queries that bring features of a type that we know nothing about."""
    root = tmp_path / "foreign"
    shutil.copytree(finished / "map", root / "map", symlinks=True)
    shutil.copytree(scene / "query", root / "query")
    for part in ("map", "query"):
        folder = KaptureFolder(finished / part, features_dirs=[finished])
        ours = {"keypoints": folder.keypoints("rootsift")}
        ours |= {"descriptors": folder.descriptors("rootsift")}
        for kind, reader in ours.items():
            shutil.rmtree(root / part / "reconstruction" / kind, ignore_errors=True)
            owner = "orb_800" if kind == "descriptors" else None
            config = replace(reader.config, name="ORB", keypoints_type=owner)
            with FeatureWriter(root / part, kind, "orb_800", config) as writer:
                for image in folder.read().image_names():
                    writer.write(image, reader.read(image))
    seen = root / "map" / "reconstruction" / "observations.txt"
    seen.write_text(seen.read_text().replace("rootsift", "orb_800"))
    shutil.rmtree(root / "map" / "reconstruction" / "global_features")
    return root


def test_a_map_of_another_tool_stays_as_it_is(megloc: Any, foreign: Path, scene: Path) -> None:
    before = state(foreign)
    result = foreign.parent / "localized"
    done = megloc("localize", "-i", foreign / "map", "--query", foreign / "query", "-o", result)
    assert done.out.startswith("4 of 4 queries localized in "), done
    share, median_m, median_deg = medians(result, scene / "query_gt")
    assert share == 1.0 and median_m < 0.01 and median_deg < 0.05
    assert state(foreign) == before
    assert "no extractor for orb_800" in megloc("info", foreign / "map").out


def test_the_foreign_map(megloc: Any, shared_data: Path, tmp_path: Path) -> None:
    place = shared_data / "foreign_maps" / "virtual_gallery"
    before = state(place)
    result = tmp_path / "localized"
    done = megloc("localize", "-i", place / "map", "--query", place / "query", "-o", result)
    assert done.status == 0
    assert done.out.startswith("4 of 4 queries localized in ")
    assert "pixel origin: centre" in done.err
    share, median_m, median_deg = medians(result, place / "query_gt")
    assert share == 1.0
    assert median_m <= 0.010 and median_deg <= 0.16
    assert state(place) == before
    # what is written is kapture
    theirs = kapture_from_dir(str(result))
    ours = KaptureFolder(result).read()
    assert len(theirs.records_camera.data_list()) == 4
    poses = {
        (timestamp, device): theirs.trajectories[timestamp, device]
        for timestamp, device in theirs.trajectories.key_pairs()
    }
    assert poses.keys() == ours.trajectories.keys()
    for key, pose in poses.items():
        np.testing.assert_allclose(pose.t_raw, ours.trajectories[key].translation, atol=1e-12)
    statuses = read_status(result / "status.csv")
    assert list(statuses) == ours.image_names()
    assert all(s.status == "localized" and s.num_inliers > 50 for s in statuses.values())


@pytest.mark.parametrize("preset", ["modern", "megloc"])
def test_the_foreign_map_needs_no_weights_of_ours(
    megloc: Any, shared_data: Path, tmp_path: Path, preset: str
) -> None:
    """It brings its own R2D2 and AP-GeM, and so do its queries."""
    place = shared_data / "foreign_maps" / "virtual_gallery"
    result = tmp_path / "localized"
    places = ("-i", place / "map", "--query", place / "query", "-o", result)
    done = megloc("localize", *places, "--preset", preset)
    assert done.out.startswith("4 of 4 queries localized in ")
    assert "localizing with r2d2_500" in done.err
    _, median_m, median_deg = medians(result, place / "query_gt")
    assert median_m <= 0.010 and median_deg <= 0.16
    # what could not be done is said: pairs with few matches would be extracted again
    remarks = {status.remarks for status in read_status(result / "status.csv").values()}
    if preset == "megloc":
        assert remarks == {
            "guided pyramid matching: the weights that extract r2d2_500 are missing "
            "(megloc weights list)"
        }
        assert "left out of 4 queries: guided pyramid matching" in done.err
    else:
        assert remarks == {""}
    # who asks for it by name is refused instead
    refused = megloc("localize", *places, "-f", "--set", "guided_pyramid.mode=all")
    refused.refused("--set guided_pyramid changes nothing: the weights that extract r2d2_500")


def test_proxy_folders_of_kapture_localization(
    megloc: Any, shared_data: Path, tmp_path: Path
) -> None:
    """Its normal intermediate: a kapture folder whose parts are links."""
    symlink = pytest.importorskip("kapture_localization.utils.symlink")
    place = shared_data / "foreign_maps" / "virtual_gallery"
    for part in ("map", "query"):
        data = place / part / "reconstruction"
        symlink.create_kapture_proxy(
            str(tmp_path / part),
            str(place / part),
            [str(data / "keypoints" / "r2d2_500")],
            [str(data / "descriptors" / "r2d2_500")],
            [str(data / "global_features" / "AP-GeM-LM18")],
            None,
            ["r2d2_500"],
            ["r2d2_500"],
            ["AP-GeM-LM18"],
            force=True,
        )
    for points in ("points3d.txt", "observations.txt"):
        link = tmp_path / "map" / "reconstruction" / points
        link.symlink_to((place / "map" / "reconstruction" / points).resolve())
    places = ("-i", tmp_path / "map", "--query", tmp_path / "query", "-o", tmp_path / "localized")
    # links lead only where the user lets them
    megloc("localize", *places).refused("lies behind a link that leaves .*--allow-links-below")
    elsewhere = ("--allow-links-below", tmp_path)
    megloc("localize", *places, *elsewhere).refused("lies behind a link that leaves")
    allowed = ("--allow-links-below", place)
    done = megloc("localize", *places, *allowed)
    assert done.out.startswith("4 of 4"), done
    as_it_is = ("-i", place / "map", "--query", place / "query", "-o", tmp_path / "expected")
    assert megloc("localize", *as_it_is).status == 0
    for name in ("status.csv", "sensors/trajectories.txt"):
        expected = (tmp_path / "expected" / name).read_bytes()
        assert (tmp_path / "localized" / name).read_bytes() == expected
    assert described(megloc("info", tmp_path / "map", *allowed).out)["points"] == "630"


def test_without_output_it_goes_to_localized(
    megloc: Any, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = (shared_data / "foreign_maps" / "virtual_gallery").resolve()
    monkeypatch.chdir(tmp_path)
    done = megloc("localize", "-i", place / "map", "--query", place / "query")
    assert done.status == 0
    assert "in localized" in done.out
    assert len(KaptureFolder(tmp_path / "localized").read().poses()) == 4


def test_our_own_output_is_written_anew(megloc: Any, gallery: Path, contents: Any) -> None:
    places = ["-i", gallery / "map", "--query", gallery / "query", "-o", gallery / "localized"]
    assert megloc("localize", *places).status == 0
    expected = contents(gallery / "localized")
    assert megloc("localize", *places, "--workers", "1").status == 0
    assert contents(gallery / "localized") == expected


def test_given_pairs_take_the_place_of_retrieval(megloc: Any, gallery: Path) -> None:
    names = KaptureFolder(gallery / "query").read().image_names()
    chosen = [f"{IMAGES}{n}.jpg" for n in (226, 224, 223)]
    pairs = [
        ImagePair(query, image, 1.0 - 0.1 * rank)
        for query in names[1:]
        for rank, image in enumerate(chosen)
    ]
    write_pairs(gallery / "pairs.txt", pairs)
    places = ["-i", gallery / "map", "--query", gallery / "query", "-o", gallery / "localized"]
    options = ["--pairs", gallery / "pairs.txt"]
    megloc("localize", *places, *options, "--set", "query_pairs.top_k=1").refused(
        "--set query_pairs changes nothing: --pairs gives the candidates"
    )
    assert megloc("localize", *places, *options).status == 0
    statuses = read_status(gallery / "localized" / "status.csv")
    assert statuses[names[0]].reason == "no map image is a candidate"
    for name in names[1:]:
        assert set(statuses[name].candidates) <= set(chosen)
    assert max(len(s.candidates) for s in statuses.values()) > 1


def test_pairs_may_name_map_images_without_a_pose(megloc: Any, gallery: Path) -> None:
    trajectories = gallery / "map" / "sensors" / "trajectories.txt"
    rows = trajectories.read_text().splitlines(keepends=True)
    trajectories.write_text("".join(row for row in rows if not re.match(r" *1, cam_00001", row)))
    names = KaptureFolder(gallery / "query").read().image_names()
    images = KaptureFolder(gallery / "map").read().image_names()
    pairs = [ImagePair(query, image, 1.0) for query in names for image in images]
    write_pairs(gallery / "pairs.txt", pairs)
    places = ["-i", gallery / "map", "--query", gallery / "query", "-o", gallery / "localized"]
    assert megloc("localize", *places, "--pairs", gallery / "pairs.txt").out.startswith("4 of 4")
    used = {
        image
        for status in read_status(gallery / "localized" / "status.csv").values()
        for image in status.candidates
    }
    assert used == set(images) - {f"{IMAGES}223.jpg"}


@pytest.mark.parametrize("by", ["AP-GeM-LM18", "VLAD over the map's descriptors"])
def test_retrieval_by_what_both_bring_else_by_our_own(megloc: Any, gallery: Path, by: str) -> None:
    if by.startswith("VLAD"):
        shutil.rmtree(gallery / "query" / "reconstruction" / "global_features")
    places = ["-i", gallery / "map", "--query", gallery / "query", "-o", gallery / "localized"]
    done = megloc("localize", *places, "--set", "query_pairs.top_k=5")
    assert done.out.startswith("4 of 4")
    assert re.search(rf"^candidates: (global features )?{by}$", done.err, re.MULTILINE)
    statuses = read_status(gallery / "localized" / "status.csv")
    assert {len(s.candidates) for s in statuses.values()} == {5}


def test_features_are_extracted_where_there_is_an_extractor(
    megloc: Any, finished: Path, scene: Path, tmp_path: Path
) -> None:
    options = ["--set", "local_features.options.max_keypoints=800"]
    places = ["-i", finished / "map", "--query", scene / "query", "-o", tmp_path / "localized"]
    done = megloc("localize", *places, *options)
    assert done.out.startswith("4 of 4"), done
    share, median_m, median_deg = medians(tmp_path / "localized", scene / "query_gt")
    assert median_m < 0.01 and median_deg < 0.05


def test_map_images_localize_in_their_own_map(
    megloc: Any, finished: Path, scene: Path, tmp_path: Path
) -> None:
    # equal names in map and query do no harm here: results are named by query alone
    places = ["-i", finished / "map", "--query", scene / "mapping", "-o", tmp_path / "localized"]
    done = megloc("localize", *places, "--features-dir", finished)
    assert done.out.startswith("7 of 7"), done
    _, median_m, _ = medians(tmp_path / "localized", scene / "mapping")
    assert median_m < 0.01


def not_finite(content: bytes) -> bytes:
    values = np.frombuffer(content, "<f4").copy()
    values[7] = np.nan
    return values.tobytes()


KEYPOINTS = "local_features/rootsift/keypoints/{}.kpt"
DESCRIPTORS = "local_features/rootsift/descriptors/{}.desc"
VECTORS = "global_features/vlad_rootsift/global_features/{}.gfeat"


@pytest.mark.parametrize(
    ("path", "change", "reason"),
    [
        (KEYPOINTS, not_finite, "not all values are finite"),
        (DESCRIPTORS, not_finite, "not all values are finite"),
        (VECTORS, not_finite, "not all values are finite"),
        (KEYPOINTS, lambda content: content[:-3], "are not whole rows of 2 x float32; truncated?"),
        (DESCRIPTORS, lambda content: content[:-512], "799 descriptors for 800 keypoints"),
        (VECTORS, lambda content: content[:-4], "are not exactly one row of"),
    ],
)
def test_broken_features_of_a_query_fail_it_and_those_of_the_map_end_the_run(
    megloc: Any,
    finished: Path,
    scene: Path,
    tmp_path: Path,
    path: str,
    change: Callable[[bytes], bytes],
    reason: str,
) -> None:
    features, output = tmp_path / "features", tmp_path / "localized"
    for part in ("local_features", "global_features"):
        shutil.copytree(finished / part, features / part)
    spoilt = features / path.format("0001.jpg")
    spoilt.write_bytes(change(spoilt.read_bytes()))
    queries = ["--query", scene / "query", "--features-dir", features]
    top = ["--set", "query_pairs.top_k=3"]  # or nothing would be ranked
    done = megloc("localize", "-i", finished / "map", *queries, *top, "-o", output)
    assert done.out.startswith("3 of 4"), done
    assert "Warning" not in done.err
    status = read_status(output / "status.csv")["0001.jpg"]
    assert status.status == "failed"
    assert status.reason.startswith(f"{spoilt}: ") and reason in status.reason
    # the map's own, given beside it
    spoilt = features / path.format("0000.jpg")
    spoilt.write_bytes(change(spoilt.read_bytes()))
    bare = tmp_path / "map"
    shutil.copytree(finished / "map", bare, symlinks=True)
    for kind in ("keypoints", "descriptors", "global_features"):
        shutil.rmtree(bare / "reconstruction" / kind)
    done = megloc("localize", "-i", bare, *queries, *top, "-o", tmp_path / "none")
    done.refused(f"{spoilt}: .*{reason}")


def test_images_that_cannot_be_used_fail_their_query_alone(
    megloc: Any, finished: Path, dataset: Path, tmp_path: Path
) -> None:
    images = dataset / "query" / "sensors" / "records_data"
    names = KaptureFolder(dataset / "query").read().image_names()
    absent, small, cut, whole = names
    (images / absent).unlink()
    write_image(images / small, np.full((9, 16, 3), 90, np.uint8))
    (images / cut).write_bytes((images / cut).read_bytes()[:-2000])
    output = tmp_path / "localized"
    fallback = ("--set", "localization.fallback=retrieval")
    asked = ("localize", "-i", finished / "map", "--query", dataset / "query", *fallback)
    done = megloc(*asked, "-o", output)
    assert done.out.startswith("1 of 4"), done
    status = read_status(output / "status.csv")
    assert [status[name].status for name in names] == ["failed"] * 3 + ["localized"]
    for name, words in ((absent, "no such"), (small, "16x9"), (cut, "broken")):
        assert status[name].reason.startswith("the image cannot be used: "), name
        assert words in status[name].reason, status[name].reason
    # where none is left there is nothing to do
    (images / whole).unlink()
    write_image(images / cut, np.full((9, 16, 3), 90, np.uint8))
    megloc(*asked, "-o", tmp_path / "none").refused(f"{images / absent}: no such")


@pytest.fixture
def namesake(dataset: Path) -> Path:
    """The dataset with a query that has the name of a map image, and shows something else."""
    query = dataset / "query" / "sensors"
    (query / "records_data" / "0001.jpg").rename(query / "records_data" / "0000.jpg")
    records = query / "records_camera.txt"
    records.write_text(records.read_text().replace("0001.jpg", "0000.jpg"))
    return dataset


def test_an_image_is_not_given_the_features_of_another_of_its_name(
    megloc: Any, finished: Path, namesake: Path, tmp_path: Path
) -> None:
    told = (
        "rootsift/keypoints/0000.jpg.kpt: 0000.jpg is another image in .* than in .*/query, and "
        "both would get these keypoints; give each its own --features-dir"
    )
    output = ["-o", tmp_path / "new", "--features-dir", finished]
    query = ["--query", namesake / "query"]
    megloc("localize", "-i", finished / "map", *query, *output).refused(told)
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0000.jpg, 0002.jpg, 1\n")
    for command in (["match", "--pairs", pairs], ["pairs-query"]):
        megloc(*command, "-i", finished / "mapping", *query, *output).refused(told)
    assert not (tmp_path / "new").exists()
    # with features of its own it is localized, whatever its name
    extracted = tmp_path / "features"
    small = ["--set", "local_features.options.max_keypoints=800", "--executor", "inline"]
    assert megloc("extract-local", "-i", namesake / "query", "-o", extracted, *small).status == 0
    output = ["-o", tmp_path / "new", "--features-dir", extracted]
    done = megloc("localize", "-i", finished / "map", *query, *output)
    assert done.out.startswith("4 of 4"), done


def test_no_query_localized_is_no_error_and_a_fallback_is_marked(
    megloc: Any, finished: Path, dataset: Path, tmp_path: Path
) -> None:
    for place in (dataset / "query/sensors/records_data").iterdir():
        write_image(place, np.zeros((300, 400, 3), np.uint8))
    places = ["-i", finished / "map", "--query", dataset / "query", "-o", tmp_path / "localized"]
    done = megloc("localize", *places)
    assert done.status == 0
    assert done.out.startswith("0 of 4 queries localized in ")
    assert "warning: no query was localized; reasons are in" in done.err
    assert KaptureFolder(tmp_path / "localized").read().poses() == {}
    done = megloc("localize", *places, "--set", "localization.fallback=retrieval")
    assert done.out.rstrip().endswith(", 4 fallback poses")
    statuses = read_status(tmp_path / "localized" / "status.csv").values()
    assert {(s.status, s.fallback) for s in statuses} == {("failed", "retrieval")}
    map_poses = list(KaptureFolder(finished / "map").read().poses().values())
    poses = KaptureFolder(tmp_path / "localized").read().poses()
    assert len(poses) == 4 and all(pose in map_poses for pose in poses.values())


# ------------------------------------------------------------------ megloc info


def described(out: str) -> dict[str, str]:
    """First column to the rest, of the lines that have one."""
    return dict(re.findall(r"^(\w[\w ]*?)  +(.*)$", out, re.MULTILINE))


def test_info_says_what_the_foreign_map_allows(megloc: Any, shared_data: Path) -> None:
    done = megloc("info", shared_data / "foreign_maps" / "virtual_gallery" / "map")
    assert (done.status, done.err) == (0, "")
    told = described(done.out)
    assert told["images"] == "12 (12 PINHOLE), 12 with a pose"
    assert told["points"] == "630"
    assert told["pixel origin"].startswith("centre: ")
    assert told["map descriptors"] == "there"
    # R2D2 has an extractor, whose weights are not there
    assert told["query features"].startswith("must be given in kapture; plugin r2d2 could extract")
    assert "megloc weights fetch r2d2_WASF_N16" in told["query features"]
    # so few that all are matched; vectors without the weights that make a query's
    assert told["retrieval"] == "all 12 map images, not ranked"
    assert (
        "where queries bring AP-GeM-LM18: all 12 map images, ranked by global features AP-GeM-LM18"
    ) in done.out
    errors = re.search(r"origin: corner ([\d.]+) px, centre ([\d.]+) px", done.out)
    assert errors is not None
    assert float(errors[2]) < 0.9 * float(errors[1])


def test_info_of_our_own_map(megloc: Any, finished: Path) -> None:
    told = described(megloc("info", finished / "map", "--deep").out)
    assert told["checked"] == "everything, image by image"
    assert told["pixel origin"].startswith("corner: ")
    assert told["query features"].startswith("extracted by plugin rootsift")
    assert told["map descriptors"] == "there"


def test_info_says_what_ranks_many_images(megloc: Any, finished: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(finished / "map", tmp_path / "map", symlinks=True))
    of_vlad = root / "reconstruction" / "global_features"
    assert described(megloc("info", root).out)["retrieval"] == (
        "all 7 map images, ranked by VLAD over the map's descriptors"
    )
    shutil.rmtree(of_vlad)
    assert described(megloc("info", root).out)["retrieval"] == "all 7 map images, not ranked"
    # sixty images more, of one camera and place
    folder = KaptureFolder(root)
    data, (local_type,) = folder.read(), folder.types("keypoints")
    name = data.image_names()[0]
    timestamp, sensor = data.record_of(name)
    places = [folder.keypoints(local_type), folder.descriptors(local_type)]
    for number in range(60):
        data.records_camera[10_000 + number, sensor] = f"more/{number}.png"
        data.trajectories[10_000 + number, sensor] = data.trajectories[timestamp, sensor]
        for reader in places:
            stored = Path(reader.where(name))
            copy = stored.parents[len(Path(name).parts) - 1] / f"more/{number}.png{stored.suffix}"
            copy.parent.mkdir(exist_ok=True)
            shutil.copyfile(stored, copy)
    write_sensors(root, data)
    assert described(megloc("info", root).out)["retrieval"] == (
        "the 50 of 67 map images that are most similar by VLAD over the map's descriptors"
    )


def test_info_of_a_folder_that_is_no_map(megloc: Any, scene: Path) -> None:
    told = described(megloc("info", scene / "query").out)
    assert told["images"] == "4 (4 PINHOLE), 0 with a pose"
    assert told["localizing"] == "not possible: no points3d and observations"


def test_info_of_a_map_whose_descriptors_are_missing(megloc: Any, gallery: Path) -> None:
    shutil.rmtree(gallery / "map" / "reconstruction" / "descriptors")
    told = described(megloc("info", gallery / "map").out)
    assert told["map descriptors"] == "missing; will be extracted again by plugin r2d2"
    assert told["retrieval"] == "all 12 map images, not ranked"
    (gallery / "map" / "sensors" / "records_data").rename(gallery / "away")
    told = described(megloc("info", gallery / "map").out)
    assert told["retrieval"] == "not possible without the map's descriptors"


def test_a_map_that_contradicts_itself_is_not_localized_in_silently(
    megloc: Any, foreign: Path, scene: Path, tmp_path: Path
) -> None:
    path = foreign / "map" / "reconstruction" / "points3d.txt"
    table = np.loadtxt(path, delimiter=",")
    table[:, [1, 2]] = table[:, [2, 1]]
    np.savetxt(path, table, delimiter=", ", header="X, Y, Z, R, G, B")
    inputs = ("-i", foreign / "map", "--query", foreign / "query", "-o", tmp_path / "localized")
    text = megloc("localize", *inputs).refused("the points do not fit the keypoints")
    assert "points read as (x, z, y)" in text and "--force" in text
    assert not (tmp_path / "localized").exists()
    out = megloc("info", foreign / "map").out
    assert re.search(r"FAULT +the points do not fit .* with points read as \(x, z, y\)", out)
    # who insists gets poses that are right in that world, or reasons
    assert megloc("localize", *inputs, "-f").status == 0
    assert len(read_status(tmp_path / "localized" / "status.csv")) == 4


def test_strangers_are_refused_and_that_is_right(
    megloc: Any, dataset: Path, tmp_path: Path
) -> None:
    """A query that shows nothing of the map: refused, counted as right, with every pose wanted."""
    query = dataset / "query"
    data = KaptureFolder(query).read()
    first = data.image_names()[0]
    camera = data.camera_of(first)
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (camera.height // 8, camera.width // 8, 3), dtype=np.uint8)
    noise = np.kron(coarse, np.ones((8, 8, 1), np.uint8))
    time, sensor = data.record_of(first)
    pixels = np.zeros((camera.height, camera.width, 3), np.uint8)
    pixels[: noise.shape[0], : noise.shape[1]] = noise
    write_image(query / "sensors" / "records_data" / "stranger.png", pixels)
    with (query / "sensors" / "records_camera.txt").open("a") as file:
        file.write(f"{int(time) + 1000}, {sensor}, stranger.png\n")
    (dataset / "query_gt" / "nowhere.txt").write_text("stranger.png\n")
    workspace = tmp_path / "workspace"
    done = megloc(
        "eval", "kapture", "--root", dataset, "-w", workspace, "--executor", "inline",
        "--set", "local_features.options.max_keypoints=800",
    )  # fmt: skip
    assert done.status == 0
    text = " ".join((workspace / "evaluation" / "recall.txt").read_text().split())
    assert "1 query shows nothing of the map: 1 refused, 0 given a pose" in text
    assert (workspace / "query_gt" / "nowhere.txt").read_text() == "stranger.png\n"
    rows = read_status(workspace / "localized" / "status.csv")
    assert rows["stranger.png"].status == "failed"
    assert all(row.confidence is not None for row in rows.values() if row.status == "localized")
