"""The tables of the megloc/ folder: round trips and defaults."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from megloc_kapture.io.dataset_tables import (
    NO_TABLES,
    ImageGroup,
    Protocol,
    RelocalizationPair,
    SideTables,
    SimilarityTransform,
    World,
    read_side_tables,
    write_side_tables,
)
from megloc_kapture.values import RigidTransform


def test_absent_files_have_defaults(tmp_path: Path) -> None:
    tables = read_side_tables(tmp_path)
    assert tables.groups == tables.priors == tables.names == {} and tables.relocalization == []
    assert tables.world == World() and tables.world.unit == "m"
    pose = RigidTransform((0.5, 0.5, -0.5, 0.5), (0.1, 0.2, 0.3))
    assert tables.world.pose_in_official(pose) == pose
    protocol = tables.protocol
    assert protocol.thresholds == ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    assert protocol.pose_file_names == "full"


def test_groups_and_priors_read_back_sorted_names_and_pairs_in_their_order(tmp_path: Path) -> None:
    groups = {
        "query/b, c.jpg": ImageGroup(condition="night-rain", frame="DUC1", location="017"),
        "map/a.jpg": ImageGroup(scored=False),
    }
    priors = {"q/2.jpg": ["loc-9", "loc-10"], "q/1.jpg": ["map/7.jpg"]}
    names = {"rain/rear/2.jpg": "rear/2.png", "dawn/rear/1.jpg": "rear/1.png"}
    pairs = [RelocalizationPair("b.txt", "r/2.png", "q/1.png")] * 2
    pairs.append(RelocalizationPair("a.txt", "r/1.png", "q/1.png"))
    tables = SideTables(groups=groups, priors=priors, names=names, relocalization=pairs)
    write_side_tables(tmp_path, tables)
    read = read_side_tables(tmp_path)
    assert list(read.groups.items()) == sorted(groups.items())
    expected = {"q/1.jpg": ("map/7.jpg",), "q/2.jpg": ("loc-10", "loc-9")}
    assert list(read.priors.items()) == list(expected.items())
    assert list(read.names.items()) == list(names.items())
    assert read.relocalization == pairs


def test_world_and_protocol_read_back_with_every_digit(tmp_path: Path) -> None:
    similarity = SimilarityTransform(
        quat_wxyz=(0.5, -0.5, 0.5, 0.5), translation=(4177000.123456789, 0.1, -2e-9), scale=0.96
    )
    world = World(official_from_local=similarity, unit="m")
    protocol = Protocol(
        dataset="robotcar",
        thresholds=((0.1, None), (0.25, 2.0)),
        pose_file_names="basename",
        conditions=("dawn", "night"),
        pools={"day": ("dawn",)},
    )
    write_side_tables(tmp_path, SideTables(world=world, protocol=protocol))
    read = read_side_tables(tmp_path)
    assert read.world == world and read.protocol == protocol
    written = json.loads((tmp_path / "protocol.json").read_text())["thresholds"]
    assert written == [[0.1, None], [0.25, 2.0]]


def test_a_similarity_normalises_its_quaternion() -> None:
    quat = SimilarityTransform(quat_wxyz=(1.0005, 0, 0, 0)).quat_wxyz
    assert quat == (1.0, 0.0, 0.0, 0.0)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 10))
def test_a_pose_sees_the_same_directions_in_either_world(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    turn, pose = (
        RigidTransform.from_matrix(Rotation.random(random_state=rng).as_matrix(), at)
        for at in (np.zeros(3), rng.normal(size=3))
    )
    offset, local = rng.normal(size=3) * 1e5, rng.normal(size=(4, 3)) * 5
    similarity = SimilarityTransform(
        quat_wxyz=turn.quat_wxyz, translation=tuple(offset), scale=scale
    )
    world = World(official_from_local=similarity)
    in_official = world.pose_in_official(pose)
    # the camera sees every point in the same direction, as many official units away
    seen = in_official.apply(scale * turn.apply(local) + offset)
    np.testing.assert_allclose(seen, scale * pose.apply(local), atol=1e-8)
    back = world.pose_in_local(in_official)
    np.testing.assert_allclose(back.apply(local), pose.apply(local), atol=1e-8)


IMAGES = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
GROUPS = {
    "a.jpg": ImageGroup(location="001/rear", frame="DUC1"),
    "b.jpg": ImageGroup(location="001/left", frame="DUC1"),
    "c.jpg": ImageGroup(location="001/rear", frame="DUC2"),
}


def pools(tables: SideTables, queries: list[str]) -> dict[str, list[int]]:
    return {
        queries[at]: images.tolist()
        for positions, images in tables.pools(queries, IMAGES)
        for at in positions
    }


def test_a_prior_names_images_locations_and_frames(tmp_path: Path) -> None:
    everything = {"free": [0, 1, 2, 3]}
    assert pools(NO_TABLES, ["free"]) == pools(read_side_tables(tmp_path), ["free"]) == everything
    priors = {
        "by location": ["001/rear"],
        "by frame": ["DUC1"],
        "by image": ["d.jpg"],
        "by several": ["d.jpg", "001/rear", "a.jpg"],
        "by nothing": ["099/rear"],
    }
    write_side_tables(tmp_path, SideTables(groups=GROUPS, priors=priors))
    frames = [members.tolist() for members in SideTables(groups=GROUPS).frames(IMAGES)]
    assert frames == [[3], [0, 1], [2]]
    assert [members.tolist() for members in NO_TABLES.frames(IMAGES)] == [[0, 1, 2, 3]]
    assert pools(read_side_tables(tmp_path), [*priors, "free"]) == {
        "by location": [0, 2],
        "by frame": [0, 1],
        "by image": [3],
        "by several": [0, 2, 3],
        "by nothing": [],
        "free": [0, 1, 2, 3],
    }
