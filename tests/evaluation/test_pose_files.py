"""Pose files of visuallocalization.net and of the MLAD challenges, and their JSON files."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from poses import random_pose

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pose_files import (
    format_mlad_file,
    format_pose_file,
    package_versions,
    poses_by_image,
    read_mlad_file,
    read_pose_file,
    relative_pose,
    write_provenance,
)
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()
GOOD = "a.jpg 1 0 0 0 1.5 -0.2 3\n"
GOOD_PAIR = "100 205 1.5 -0.2 3 0.8 0 0 0.6\n"


def test_pose_files_have_the_servers_format(tmp_path: Path) -> None:
    path = tmp_path / "file"
    pose = RigidTransform((1.0, 0.0, 0.0, 0.0), (1.5, -0.2, 3.0))
    third = RigidTransform((0.5, 0.5, -0.5, 0.5), (1 / 3, -2e-17, 1e6))
    path.write_text(format_pose_file({"q/b.jpg": third, "q/a.jpg": pose}, names="basename"))
    assert path.read_text() == (
        "a.jpg 1.0 0.0 0.0 0.0 1.5 -0.2 3.0\n"
        "b.jpg 0.5 0.5 -0.5 0.5 0.3333333333333333 -2e-17 1000000.0\n"
    )
    assert read_pose_file(path) == {"a.jpg": pose, "b.jpg": third}
    rows = {(1602074877390449152, 5): RigidTransform((0.6, 0.8, 0.0, 0.0), (1 / 3, -1, 3))}
    path.write_text(format_mlad_file(rows))
    assert path.read_text() == "1602074877390449152 5 0.3333333333333333 -1.0 3.0 0.8 0.0 0.0 0.6\n"
    assert read_mlad_file(path) == rows
    assert format_pose_file({}) == format_mlad_file({}) == ""
    path.write_text("")
    assert read_pose_file(path) == {} and read_mlad_file(path) == {}


def test_the_challenge_s_list_gives_names_and_order() -> None:
    listed = {"night/rear/2.jpg": "rear/2.png", "dawn/rear/1.jpg": "rear/1.png", "x.jpg": "x.png"}
    given_poses = dict.fromkeys(["dawn/rear/1.jpg", "night/rear/2.jpg", "dawn/left/1.jpg"], HERE)
    text = format_pose_file(given_poses, names=listed)
    assert [line.split()[0] for line in text.splitlines()] == ["rear/2.png", "rear/1.png"]


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, math.inf, 0.0)), "not finite"),
        (RigidTransform((0.9, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "length 0.9"),
    ],
)
def test_invalid_poses_are_not_written(pose: RigidTransform, words: str) -> None:
    with pytest.raises(DataError, match=words):
        format_mlad_file({(1, 1): HERE, (1, 2): pose})
    with pytest.raises(DataError, match=words):
        format_pose_file({"good.jpg": HERE, "bad.jpg": pose})


@pytest.mark.parametrize(
    "text",
    [
        "a.jpg\t1  0 0 0 1.5 -0.2 3 \r\n",
        "\ufeffa.jpg 1 0 0 0 1.5 -0.2 3\n",
        "\n\na.jpg 1.0009 0 0 0 1.5 -.2 +3",
        "# name qw qx qy qz tx ty tz\na.jpg 1 0 0 0 1.5 -0.2 3\n",
        "a.jpg, 1, 0, 0, 0, 1.5, -0.2, 3\n",
        "a.jpg;1;0;0;0;1.5;-0.2;3",
        '"a.jpg","1","0","0","0","1.5","-0.2","3"\n',
        "image,qw,qx,qy,qz,tx,ty,tz,center_x\na.jpg,1,0,0,0,1.5,-0.2,3,-1.5\n",
        "image tx ty tz qx qy qz qw\na.jpg 1.5 -0.2 3 0 0 0 1\n",
        "a.jpg 1 0 0 0 1.5 -0.2 3 525.0\n",
        "a.jpg 1.0 0 0 0 1.5 -0.2 3 0.12 0.013 345\n",
        ",name,qw,qx,qy,qz,tx,ty,tz\n0,a.jpg,1,0,0,0,1.5,-0.2,3\n",
        "Image,Q_W,Q_X,Q_Y,Q_Z,T_X,T_Y,T_Z\na.jpg,1,0,0,0,1.5,-0.2,3\nb.jpg,,,,,,,\n",
        "7 1 0 0 0 1.5 -0.2 3 4 a.jpg\n1.5 2.5 -1 3.5 4.5 17\n",
        "# IMAGE_ID, QW, ...\n7 1 0 0 0 1.5 -0.2 3 4 a.jpg\n\n8 nan 0 0 0 0 0 0 4 b c.jpg\n",
        "7 1 0 0 0 1.5 -0.2 3 4 a.jpg\n8 nan 0 0 0 0 0 0 4 b.jpg\n",
    ],
)
def test_variants_of_other_tools_are_read(tmp_path: Path, text: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text, encoding="utf-8", newline="")
    assert read_pose_file(path) == {"a.jpg": RigidTransform((1.0, 0.0, 0.0, 0.0), (1.5, -0.2, 3.0))}


def test_rows_without_a_pose_are_misses(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"{GOOD}b.jpg nan nan nan nan nan nan nan\nc.jpg 0 0 0 0 1 2 3\n")
    assert list(read_pose_file(path)) == ["a.jpg"]
    assert "2 rows of nan or zeros are read as queries without a pose, such as b.jpg" in caplog.text
    rows = "# src tgt tx ty tz qx qy qz qw\n1,2,1.5,-0.2,3,0.8,0,0,0.6\r\n1 3 0 0 0 nan 0 0 1\n"
    path.write_text(rows + "1 4 0 0 0 0 0 0 0\n", newline="")
    pose = RigidTransform((0.6, 0.8, 0.0, 0.0), (1.5, -0.2, 3.0))
    assert read_mlad_file(path) == {(1, 2): pose, (1, 3): HERE, (1, 4): HERE}


@pytest.mark.parametrize(
    ("read", "good", "line", "words"),
    [
        (read_pose_file, GOOD, "b.jpg 1 0 0 0 1.5 -0.2", "7 columns instead of 8"),
        (read_pose_file, GOOD, "b.jpg 1,0 0,0 0,0 0,0 1,5 -0,2 3,0", "'1,0' is not a number"),
        (read_pose_file, GOOD, "b.jpg;1;0;0;0;1,5;-0,2;3,25", "'1,5' is not a number"),
        (read_pose_file, GOOD, "b.jpg\t1\t0\t0\t0\t1,5\t-0,2\t3,25", "'1,5' is not a number"),
        (read_pose_file, GOOD, GOOD_PAIR.strip(), "9 columns instead of 8"),
        (read_pose_file, GOOD, "0 b.jpg 1 0 0 0 1.5 -0.2 3", "'b.jpg' is not a number"),
        (read_pose_file, "7 1 0 0 0 1.5 -0.2 3 4 a.jpg\n", "8", "0 columns instead of 8"),
        (read_pose_file, GOOD, "1.5 1 2 3 0 0 0 1", "'1.5': the quaternion is last, as in world_"),
        (read_pose_file, GOOD, "b.jpg 1 2 3 1 0 0 0", "in Cambridge Landmarks .camera"),
        (read_pose_file, GOOD, "1 0 0 9 0 1 0 8 0 0 1 7", "12 columns .*other formats .KITTI"),
        (read_pose_file, GOOD, "b.jpg 1.0011 0 0 0 1 -0.2 3", "length 1.0011"),
        (read_pose_file, GOOD, "a.jpg 1 0 0 0 1 -0.2 3", "given twice"),
        (read_mlad_file, GOOD_PAIR, "100 205", "2 columns instead of 9"),
        (read_mlad_file, GOOD_PAIR, "1e2 206 0 0 0 0 0 0 1", "'1e2' is not a timestamp"),
        (read_mlad_file, GOOD_PAIR, "-100 206 0 0 0 0 0 0 1", "not a timestamp"),
        (read_mlad_file, GOOD_PAIR, "100 205 0 0 0 0 0 0 1", "pair 100 205 is given twice"),
    ],
)
def test_wrong_lines_are_named(tmp_path: Path, read: Any, good: str, line: str, words: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"{good}\n{line}\n")
    with pytest.raises(DataError, match=words) as caught:
        read(path)
    assert caught.value.line == 3 and str(caught.value).startswith(f"{path}:3: ")


def test_a_file_of_a_kapture_folder_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trajectories.txt"
    path.write_text("# kapture format: 1.1\n1, cam, 1, 0, 0, 0, 1, 2, 3\n")
    with pytest.raises(DataError, match="a file of a kapture folder; give the folder"):
        read_pose_file(path)


def test_short_names_are_matched_with_images() -> None:
    images = ["q/day/1.jpg", "q/day/2.jpg", "q/night/2.jpg"]
    result = poses_by_image({"1.jpg": HERE, "q/day/2.jpg": HERE, "9.jpg": HERE}, images)
    assert list(result) == ["q/day/1.jpg", "q/day/2.jpg", "9.jpg"]
    with pytest.raises(DataError, match="may be 'q/day/2.jpg' or 'q/night/2.jpg'"):
        poses_by_image({"2.jpg": HERE}, images)
    with pytest.raises(DataError, match=r"in two ways: '1\.jpg', 'q/day/1\.jpg'; use full names"):
        poses_by_image({"1.jpg": HERE, "q/day/1.jpg": HERE}, images)
    listed = {"dawn/rear/1.jpg": "rear/1.png", "dusk/rear/2.jpg": "rear/2.png"}
    result = poses_by_image({"rear/1.png": HERE, "dusk/rear/2.jpg": HERE}, listed, listed)
    assert list(result) == ["dawn/rear/1.jpg", "dusk/rear/2.jpg"]
    with pytest.raises(DataError, match="in two ways"):
        poses_by_image({"rear/1.png": HERE, "dawn/rear/1.jpg": HERE}, listed, listed)


def test_names_by_path_end_and_other_suffix() -> None:
    images = [
        "v2/dawn/rear/1.jpg",
        "v2/dusk/rear/2.jpg",
        "v2/dusk/left/2.jpg",
        "a/3.jpg",
        "a/3.png",
    ]
    named = ("rear/1.jpg", "left/2.png", "rear/2.JPG", "3.jpg", "4.jpg")
    result = poses_by_image(dict.fromkeys(named, HERE), images)
    assert list(result) == [images[0], images[2], images[1], "a/3.jpg", "4.jpg"]
    # neither of two that differ in their ending, nor what is no ending of an image
    strange = ["a/3.jpeg", "v2/dawn/rear/1.5"]
    assert list(poses_by_image(dict.fromkeys(strange, HERE), images)) == strange
    listed = {"v2/dawn/rear/1.jpg": "rear/1.png"}
    assert list(poses_by_image({"rear/1.jpeg": HERE}, images, listed)) == images[:1]


def test_relative_poses_are_query_from_reference() -> None:
    rng = np.random.default_rng(0)
    query, reference = random_pose(rng), random_pose(rng)
    result = relative_pose(query, reference)
    point = rng.normal(size=(1, 3)) * 1e3
    np.testing.assert_allclose(result.apply(reference.apply(point)), query.apply(point), atol=1e-9)
    scaled = relative_pose(query, reference, scale=2.5)
    assert scaled.quat_wxyz == result.quat_wxyz
    np.testing.assert_allclose(scaled.translation, 2.5 * np.array(result.translation))


def test_provenance_has_options_and_the_hash_of_the_file(tmp_path: Path) -> None:
    pose_file = tmp_path / "aachen.txt"
    pose_file.write_text("a.jpg 1 0 0 0 0 0 0\n")
    options = {"preset": "classic", "options": {"max_error_px": 8.0}}
    write_provenance(pose_file, options, counts={"queries": 2, "poses": 1})
    content = json.loads((tmp_path / "aachen.txt.json").read_text())
    assert content["files"] == {"aachen.txt": hashlib.sha256(pose_file.read_bytes()).hexdigest()}
    assert content["counts"] == {"queries": 2, "poses": 1}
    assert content["preset"] == "classic"
    assert content["options"] == {"max_error_px": 8.0}
    assert content["versions"] == package_versions()
    assert package_versions()["numpy"] == np.__version__
