"""The megloc/ folder: round trips, defaults, refusals."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    RelocalizationPair,
    SimilarityTransform,
    World,
    read_groups,
    read_names,
    read_priors,
    read_protocol,
    read_relocalization,
    read_world,
    write_groups,
    write_names,
    write_priors,
    write_protocol,
    write_relocalization,
    write_world,
)
from megloc_kapture.values import RigidTransform


def test_absent_files_stand_for_their_defaults(tmp_path: Path) -> None:
    absent = tmp_path / "megloc"
    assert read_groups(absent) == {}
    assert read_priors(absent) == {}
    assert read_world(absent) == World()
    assert read_world(absent).unit == "m"
    protocol = read_protocol(absent)
    assert protocol.thresholds == ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    assert protocol.pose_file_names == "full"


def test_groups_read_back(tmp_path: Path) -> None:
    groups = {
        "query/b, c.jpg": ImageGroup(condition="night-rain", frame="DUC1", location="017"),
        "map/a.jpg": ImageGroup(scored=False),
    }
    write_groups(tmp_path, groups)
    assert read_groups(tmp_path) == groups
    assert list(read_groups(tmp_path)) == ["map/a.jpg", "query/b, c.jpg"]


@pytest.mark.parametrize(
    ("rows", "line", "words"),
    [
        ("a.jpg,day,,,1\na.jpg,day,,,1\n", 3, "is given twice"),
        ("a.jpg,day,,,yes\n", 2, "scored 'yes' is not 0 or 1"),
        (",day,,,1\n", 2, "empty path"),
        ("../a.jpg,day,,,1\n", 2, "leads out"),
        ("/a.jpg,day,,,1\n", 2, "absolute"),
    ],
)
def test_broken_groups(tmp_path: Path, rows: str, line: int, words: str) -> None:
    (tmp_path / "groups.csv").write_text(f"image,condition,frame,location,scored\n{rows}")
    with pytest.raises(DataError, match=words) as caught:
        read_groups(tmp_path)
    assert caught.value.line == line


def test_priors_read_back_sorted(tmp_path: Path) -> None:
    write_priors(tmp_path, {"q/2.jpg": ["loc-9", "loc-10"], "q/1.jpg": ["map/7.jpg"]})
    assert (tmp_path / "priors.csv").read_text() == (
        "query,permitted\nq/1.jpg,map/7.jpg\nq/2.jpg,loc-10\nq/2.jpg,loc-9\n"
    )
    assert read_priors(tmp_path) == {"q/1.jpg": ("map/7.jpg",), "q/2.jpg": ("loc-10", "loc-9")}


def test_a_prior_that_permits_nothing_is_refused(tmp_path: Path) -> None:
    # the table has no way to say it, and an absent query may be matched with everything
    with pytest.raises(DataError, match="permits nothing"):
        write_priors(tmp_path, {"q.jpg": []})


@pytest.mark.parametrize(
    ("rows", "words"),
    [("q.jpg,\n", "permitted is empty"), ("q.jpg,a\nq.jpg,a\n", "twice"), (",a\n", "empty path")],
)
def test_broken_priors(tmp_path: Path, rows: str, words: str) -> None:
    (tmp_path / "priors.csv").write_text(f"query,permitted\n{rows}")
    with pytest.raises(DataError, match=words):
        read_priors(tmp_path)


def test_world_reads_back_to_the_last_digit(tmp_path: Path) -> None:
    similarity = SimilarityTransform(
        quat_wxyz=(0.5, -0.5, 0.5, 0.5), translation=(4177000.123456789, 0.1, -2e-9), scale=0.96
    )
    world = World(official_from_local=similarity, unit="m")
    write_world(tmp_path, world)
    assert read_world(tmp_path) == world


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"official_from_local": {"quat_wxyz": [1, 1, 0, 0]}}', "quat_wxyz: quaternion of length"),
        ('{"official_from_local": {"quat_wxyz": [1, 0, 0]}}', "quat_wxyz"),
        ('{"official_from_local": {"scale": 0}}', "scale"),
        ('{"official_from_local": {"scale": NaN}}', "NaN"),
        ('{"official_from_local": {"translation": [1e999, 0, 0]}}', "finite"),
        ('{"origin": 1}', "origin"),
        ('{"unit": "m",\n  "unit', "not JSON"),
        ("[]", "dict"),
    ],
)
def test_broken_worlds_name_the_field(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "world.json").write_text(content)
    with pytest.raises(DataError, match=words) as caught:
        read_world(tmp_path)
    assert "world.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_broken_json_names_the_line(tmp_path: Path) -> None:
    (tmp_path / "protocol.json").write_text('{"dataset": "x",\n "thresholds": [[1 2]]}')
    with pytest.raises(DataError) as caught:
        read_protocol(tmp_path)
    assert caught.value.line == 2


def test_a_quaternion_slightly_off_is_normalised() -> None:
    quat = SimilarityTransform(quat_wxyz=(1.0005, 0, 0, 0)).quat_wxyz
    assert quat == (1.0, 0.0, 0.0, 0.0)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 10))
def test_official_poses_see_the_same_and_come_back(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    offset = tuple(rng.normal(size=3) * 1e5)
    world = World(
        official_from_local=SimilarityTransform(
            quat_wxyz=tuple(quat / np.linalg.norm(quat)), translation=offset, scale=scale
        )
    )
    quat = rng.normal(size=4)
    pose = RigidTransform(tuple(quat / np.linalg.norm(quat)), tuple(rng.normal(size=3)))
    local = rng.normal(size=(4, 3)) * 5
    similarity = world.official_from_local
    turned = RigidTransform(similarity.quat_wxyz, (0.0, 0.0, 0.0)).apply(local)
    official = scale * turned + np.array(offset)
    in_official = world.pose_in_official(pose)
    # the camera sees every point in the same direction, as many official units away
    np.testing.assert_allclose(in_official.apply(official), scale * pose.apply(local), atol=1e-8)
    back = world.pose_in_local(in_official)
    np.testing.assert_allclose(back.apply(local), pose.apply(local), atol=1e-8)


def test_identity_world_changes_no_digit() -> None:
    pose = RigidTransform((0.5, 0.5, -0.5, 0.5), (0.1, 0.2, 0.3))
    assert World().pose_in_official(pose) == pose


def test_protocol_reads_back(tmp_path: Path) -> None:
    protocol = Protocol(
        dataset="robotcar",
        thresholds=((0.1, None), (0.25, 2.0)),
        pose_file_names="basename",
        conditions=("dawn", "night"),
        pools={"day": ("dawn",)},
    )
    write_protocol(tmp_path, protocol)
    assert read_protocol(tmp_path) == protocol
    assert json.loads((tmp_path / "protocol.json").read_text())["thresholds"] == [
        [0.1, None],
        [0.25, 2.0],
    ]


@pytest.mark.parametrize(
    "change",
    [
        {"thresholds": []},
        {"thresholds": [[-1.0, 2.0]]},
        {"thresholds": [[0.25, -2.0]]},
        {"thresholds": [[0.25]]},
        {"pose_file_names": "stem"},
        {"conditions": ["day", "day"]},
        {"threshold": [[0.25, 2.0]]},
    ],
)
def test_broken_protocols(tmp_path: Path, change: dict) -> None:
    (tmp_path / "protocol.json").write_text(json.dumps(change))
    with pytest.raises(DataError, match=r"protocol\.json"):
        read_protocol(tmp_path)


def test_names_keep_their_order(tmp_path: Path) -> None:
    names = {"rain/rear/2.jpg": "rear/2.png", "dawn/rear/1.jpg": "rear/1.png"}
    write_names(tmp_path, names)
    assert list(read_names(tmp_path).items()) == list(names.items())
    assert (tmp_path / "names.csv").read_text().splitlines()[1] == "rain/rear/2.jpg,rear/2.png"


def test_pairs_keep_their_order(tmp_path: Path) -> None:
    pairs = [RelocalizationPair("b.txt", "r/2.png", "q/1.png")] * 2
    pairs.append(RelocalizationPair("a.txt", "r/1.png", "q/1.png"))
    write_relocalization(tmp_path, pairs)
    assert read_relocalization(tmp_path) == pairs


def test_absent_tables_are_empty(tmp_path: Path) -> None:
    assert read_names(tmp_path) == {} and read_relocalization(tmp_path) == []


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("a.jpg,x\na.jpg,y\n", r"names\.csv:3: image 'a\.jpg' is given twice"),
        ("a.jpg,x\nb.jpg,x\n", r"names\.csv:3: name 'x' is given twice"),
        ("a.jpg,x y\n", r"names\.csv:2: a pose file cannot hold the name 'x y'"),
        ("../a.jpg,x\n", r"names\.csv:2: "),
        ("a.jpg\n", r"names\.csv:2: "),
    ],
)
def test_broken_names(tmp_path: Path, rows: str, message: str) -> None:
    (tmp_path / "names.csv").write_text(f"image,name\n{rows}")
    with pytest.raises(DataError, match=message):
        read_names(tmp_path)


def test_a_pose_file_outside_is_refused(tmp_path: Path) -> None:
    (tmp_path / "relocalization.csv").write_text("file,reference,query\n../../x.txt,a,b\n")
    with pytest.raises(DataError, match=r"relocalization\.csv:2: "):
        read_relocalization(tmp_path)
    with pytest.raises(DataError):
        write_relocalization(tmp_path, [RelocalizationPair("/etc/x", "a", "b")])


READERS = {
    "groups.csv": read_groups,
    "priors.csv": read_priors,
    "names.csv": read_names,
    "relocalization.csv": read_relocalization,
    "world.json": read_world,
    "protocol.json": read_protocol,
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_plain_table_of_the_dataset_is_refused(name: str, tmp_path: Path) -> None:
    place = tmp_path / "dataset" / "megloc" / name
    place.parent.mkdir(parents=True)
    os.mkfifo(place)
    with pytest.raises(DataError, match=f"{name}: not a plain file"):
        READERS[name](place.parent)
    place.unlink()
    with open(place, "wb") as file:
        file.truncate(1 << 34)  # takes no room on the disk
    with pytest.raises(DataError, match=f"{name}: larger than 256 MB"):
        READERS[name](place.parent)
    for target in ("/dev/zero", tmp_path / "elsewhere"):
        place.unlink()
        place.symlink_to(target)
        (tmp_path / "elsewhere").write_text("{}")
        with pytest.raises(DataError, match=f"{name}: is or lies behind a link that leaves"):
            READERS[name](place.parent)
