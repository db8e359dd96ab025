"""Mutated and random files: each reader gives a result or a DataError that names the file.

The table READERS has the readers of ``megloc_kapture.io`` with the bytes that are mutated. The
quick tier draws a few examples of each, the tests marked ``fuzz`` many.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import torch
from hostile import EDITS, NUMBERS, TOKENS, Edit, changed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import save
from scipy.io import savemat

from megloc_kapture.errors import DataError
from megloc_kapture.io import dataset_tables, tables, weights
from megloc_kapture.io.images import image_size, read_image_rgb
from megloc_kapture.io.kapture import read_pairs, read_point_covariances, write_pairs
from megloc_kapture.io.kapture.blobs import TarBlobs
from megloc_kapture.io.kapture.features import DTYPES, read_config
from megloc_kapture.io.kapture.observations import Observations, read_observations
from megloc_kapture.io.kapture.points import read_points3d
from megloc_kapture.io.kapture.sensors import read_kapture_data
from megloc_kapture.io.mat_file import read_mat, read_mat_array

VERSION = "# kapture format: 1.1\n"
POSE = "0.5, 0.5, 0.5, 0.5, 1.0, -2.0, 3.0"
CELL = "1.0 0.0 0.0 0.0 1.0 -2.0 3.0"
# both readers are asked everything: files of any size go to the one or to the other
PLAIN, LARGE = 1 << 62, 0


class Reader(NamedTuple):
    """A file that is read, relative to a folder, and its bytes before they are mutated."""

    file: str
    whole: bytes
    read: Callable[[Path], object]


def saved_mat(*, compressed: bool) -> bytes:
    out, cells = io.BytesIO(), np.empty((1, 2), object)
    cells[0, 0], cells[0, 1] = np.arange(24.0).reshape(2, 3, 4), {"type": "conv", "w": np.ones(3)}
    savemat(out, {"net": {"layers": cells}, "XYZ": np.eye(3)}, do_compression=compressed)
    return out.getvalue()


def saved_torch(content: Any, *, legacy: bool = False) -> bytes:
    out = io.BytesIO()
    torch.save(content, out, _use_new_zipfile_serialization=not legacy)
    return out.getvalue()


def saved_tar(members: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            info.mtime = 0.5 if name.startswith("e") else 0  # in a header of its own
            tar.addfile(info, io.BytesIO(content))
    return out.getvalue()


def saved_array() -> bytes:
    out = io.BytesIO()
    np.save(out, np.arange(18.0).reshape(3, 6))
    return out.getvalue()


def encoded(suffix: str) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    return bytes(cv2.imencode(suffix, pixels)[1])


def read_images(path: Path) -> None:
    for read in (read_image_rgb, image_size):
        with suppress(DataError):
            read(path)
    read_image_rgb(path)


def read_sensors(path: Path) -> None:
    for pose in read_kapture_data(path.parent.parent).trajectories.values():
        assert abs(np.linalg.norm(pose.quat_wxyz) - 1) < 1e-12


def read_tar(path: Path) -> None:
    blobs = TarBlobs(path.parent, path, ".kpt")
    for name in blobs.names():
        blobs.read(name)


def beside(read: Callable[[Path], object]) -> Callable[[Path], object]:
    """A reader that is given the file's folder."""
    return lambda path: read(path.parent)


def read_mats(path: Path) -> None:
    content = path.read_bytes()
    with suppress(DataError):
        read_mat(content)
    found = read_mat_array(path, "XYZ")
    assert found.dtype == np.float64 and found.size * 8 <= len(content) * 1032


def read_weights(path: Path) -> None:
    weights.read_weights(weights.describe(path.name, path))


def read_pairs_again(path: Path) -> None:
    pairs = read_pairs(path)
    write_pairs(path, pairs)
    assert read_pairs(path) == pairs


def rows(observations: dict[str, Observations]) -> dict[str, list[tuple[int, str, int]]]:
    """Observations as rows of point, image and keypoint."""
    return {
        kind: [
            (point, found.image_names[image], keypoint)
            for point, image, keypoint in zip(
                *(a.tolist() for a in (found.point_ids, found.image_ids, found.keypoint_ids)),
                strict=True,
            )
        ]
        for kind, found in observations.items()
    }


def outcome(read: Callable[..., Any], path: Path, **options: int) -> Any:
    try:
        return read(path, **options)
    except DataError as error:
        assert path.name in str(error)
        return None


def read_twice(
    read: Callable[..., Any], comparable: Callable[[Any], Any], path: Path, **options: int
) -> None:
    """By both readers, the compiled one in chunks of a few lines: they agree on anything."""
    plain = outcome(read, path, large_bytes=PLAIN)
    compiled = outcome(read, path, large_bytes=LARGE, **options)
    assert (plain is None) == (compiled is None)
    assert plain is None or comparable(plain) == comparable(compiled)
    read(path)


TENSORS = {"a.weight": torch.arange(6.0).reshape(2, 3), "a.count": torch.tensor(7)}
SENSORS = {
    "sensors": f"{VERSION}cam, , camera, PINHOLE, 640, 480, 500, 500, 320, 240\nd, , depth, "
    "SIMPLE_PINHOLE, 64, 48, 50, 32, 24\n",
    "rigs": f"rig, cam, {POSE}\nrig, d, {POSE}\n",
    "trajectories": f"1, rig, {POSE}\n2, cam, , , , , , , \n",
    "records_camera": "1, cam, a.jpg\n2, cam, b/c.jpg\n",
    "records_depth": "1, d, a.depth\n",
}
READERS = {
    **{
        name: Reader(f"sensors/{name}.txt", content.encode(), read_sensors)
        for name, content in SENSORS.items()
    },
    "observations": Reader(
        "observations.txt",
        b"0, t, a b.jpg, 1, c, 2\n# c\n5, u, c, 07\n",
        partial(read_twice, read_observations, rows, chunk_bytes=50),
    ),
    "points": Reader(
        "points3d.txt",
        b"# X, Y, Z\n1.5,-2e3,.5\n1,2,3\n",
        partial(read_twice, read_points3d, lambda points: points.view(np.uint64).tolist()),
    ),
    "covariances": Reader(
        "reconstruction/point_covariances.npy",
        saved_array(),
        lambda path: read_point_covariances(path.parent.parent, 3),
    ),
    "pairs": Reader("pairs.txt", b"# q, m, s\na, b, 1.5\nb/c, a, -2\n", read_pairs_again),
    "configuration": Reader(
        "descriptors.txt",
        b"sift, float32, 128, sift, L2\n",
        lambda path: DTYPES[read_config(path, "descriptors").dtype.name],
    ),
    "features in a tar": Reader(
        "x.tar", saved_tar({"a.kpt": b"1234", "e/f.kpt": b"", "c.kpt": bytes(700)}), read_tar
    ),
    "jpg": Reader("x.jpg", encoded(".jpg"), read_images),
    "png": Reader("x.png", encoded(".png"), read_images),
    "bmp": Reader("x.bmp", encoded(".bmp"), read_images),
    "status": Reader(
        "status.csv",
        b"image,status,reason,num_matches,num_inliers,cluster,fallback,candidates,refinement,"
        b'remarks\na,localized,,9,8,0,none,"b,c",,\nd,failed,why,0,0,,rig,,,\n',
        tables.read_status,
    ),
    "clusters": Reader(
        "clusters.csv",
        b"image,cluster,chosen,num_matches,num_inliers,score,reason,images,cam_from_world\n"
        + f'a,0,yes,4,3,1.5,,"b,c",{CELL}\n'.encode(),
        tables.read_clusters,
    ),
    "refinement": Reader(
        "refinement.csv",
        b"image,method,accepted,reason,moved_m,turned_deg,measures,before\n"
        + f"a,icp,yes,,0.1,0.2,m=1;n=2,{CELL}\n".encode(),
        tables.read_refinement,
    ),
    "consistency": Reader(
        "map_consistency.csv",
        b"frame,method,images,contradicting,moved_m,turned_deg,moved_px,claimed_m,claimed_deg,"
        b"squared_distance,reason\n,icp,3,0,0.1,,1,2,3,4,\n",
        tables.read_consistency,
    ),
    "match counts": Reader(
        "local_features/t/match_counts.csv",
        b"image,other,matches,verified\na,b,3,2\n",
        lambda path: tables.read_match_counts(path.parent.parent.parent, "t"),
    ),
    "mask counts": Reader(
        "local_features/t/masked.csv",
        b"image,num_masked\na,3\n",
        lambda path: tables.read_mask_counts(path.parent.parent.parent, "t"),
    ),
    "groups": Reader(
        "groups.csv",
        b"image,condition,frame,location,scored\na,day,,,1\n",
        beside(dataset_tables.read_groups),
    ),
    "priors": Reader(
        "priors.csv", b"query,permitted\na,b\na,c\n", beside(dataset_tables.read_priors)
    ),
    "names": Reader("names.csv", b"image,name\na,b\n", beside(dataset_tables.read_names)),
    "world": Reader(
        "world.json",
        b'{"official_from_local": {"quat_wxyz": [0.6, 0, 0.8, 0], "scale": 2}, "unit": "m"}',
        beside(dataset_tables.read_world),
    ),
    "protocol": Reader(
        "protocol.json",
        b'{"dataset": "x", "thresholds": [[0.25, 2.0], [5, null]], "pools": {"a": ["b"]}}',
        beside(dataset_tables.read_protocol),
    ),
    "mat": Reader("x.mat", saved_mat(compressed=False), read_mats),
    "mat, packed": Reader("x.mat", saved_mat(compressed=True), read_mats),
    "torch": Reader("x.pth", saved_torch(TENSORS), read_weights),
    "torch, legacy": Reader(
        "x.pth", saved_torch({"state_dict": TENSORS}, legacy=True), read_weights
    ),
    "safetensors": Reader("x.safetensors", save(TENSORS), read_weights),
}


def placed(reader: Reader, folder: Path, content: bytes) -> Path:
    """Write some bytes as the reader's file, with what belongs beside it."""
    path = folder / reader.file
    path.parent.mkdir(parents=True, exist_ok=True)
    if reader.read is read_sensors:
        for name, table in SENSORS.items():
            (path.parent / f"{name}.txt").write_text(table)
    path.write_bytes(content)
    return path


def survives(reader: Reader, folder: Path, content: bytes) -> None:
    """Read some bytes as the reader's file: nothing comes of it but a result or a DataError."""
    path = placed(reader, folder, content)
    try:
        reader.read(path)
    except DataError as error:
        assert "\n" not in str(error)
        # a broken table of sensors/ may show in another one
        assert (path.parent.name if reader.read is read_sensors else path.name) in str(error)
    except MemoryError:
        pass


ANY = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
MANY = settings(ANY, max_examples=400)
EACH = pytest.mark.parametrize("name", READERS)


@EACH
def test_whole_files_are_read(name: str, tmp_path: Path) -> None:
    """What is mutated is right to begin with; else the mutations would show nothing."""
    reader = READERS[name]
    path = placed(reader, tmp_path, reader.whole)
    if name == "NetVLAD":  # a MAT file, but not of this network
        with pytest.raises(DataError, match="not NetVLAD's struct net"):
            reader.read(path)
    else:
        reader.read(path)


@EACH
@given(edits=EDITS)
@ANY
def test_mutations(name: str, tmp_path: Path, edits: list[Edit]) -> None:
    survives(READERS[name], tmp_path, changed(READERS[name].whole, edits))


@pytest.mark.fuzz
@EACH
@given(edits=EDITS)
@MANY
def test_many_mutations(name: str, tmp_path: Path, edits: list[Edit]) -> None:
    survives(READERS[name], tmp_path, changed(READERS[name].whole, edits))


@pytest.mark.fuzz
@EACH
@given(st.binary(max_size=300) | st.lists(TOKENS, max_size=40).map(b"".join), st.booleans())
@ANY
def test_random_bytes(name: str, tmp_path: Path, content: bytes, ended: bool) -> None:
    survives(READERS[name], tmp_path, READERS[name].whole * ended + content)


FIELDS = st.sampled_from(
    ["0", "1", "17", " 5 ", "007", "-1", "x", "", "t", "u u", "a.jpg", "b/c d.jpg", "é", "..", "#"]
    + ["\u2003", "9" * 18, "9" * 19, "\t3", "a\u00a0", "\0", "2147483647", "2147483648"]
)
GOOD = st.builds(
    lambda point, kind, pairs: f"{point}, {kind}" + "".join(f", {i}, {k}" for i, k in pairs),
    st.integers(0, 40),
    st.sampled_from(["t", "u", "v w"]),
    st.lists(
        st.tuples(st.sampled_from(["a", "b/c d", "é" * 20, "x" * 70]), st.integers(0, 99)),
        max_size=5,
    ),
)
OBSERVATION_ROWS = (
    GOOD
    | st.lists(FIELDS, max_size=7).map(", ".join)
    | st.sampled_from(["", "# c", "#é", " ", "\r", "\u2003"])
)
OBSERVATION_FILES = st.builds(
    lambda rows, end, tail: end.join(rows) + tail,
    st.lists(OBSERVATION_ROWS, max_size=12),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from(["", "\n", "\n\n"]),
).map(str.encode) | st.binary(max_size=200)


@given(st.lists(GOOD, min_size=1).map(lambda r: "\n".join(r).encode()) | OBSERVATION_FILES)
@MANY
@pytest.mark.fuzz
def test_both_readers_of_observations_agree(tmp_path: Path, content: bytes) -> None:
    survives(READERS["observations"], tmp_path, content)


POINT_FIELDS = NUMBERS | st.sampled_from(
    ["", "x", "nan", "1e999", "1 2", " 5\t", ".", "-", "1e", "\0"]
)
POINT_ROWS = st.lists(NUMBERS, min_size=3, max_size=3) | st.lists(POINT_FIELDS, max_size=7)
POINT_FILES = (
    st.lists(
        POINT_ROWS.map(",".join)
        | st.sampled_from(["", "# c", "#é", "\u2003", "\r", '"1",2,3', "1,2,3 # c", "True,1,2"]),
        max_size=10,
    )
    .map("\n".join)
    .map(str.encode)
) | st.text(st.sampled_from("0123456789+-.eE, \t\r\n#"), max_size=60).map(str.encode)


@given(POINT_FILES)
@MANY
@pytest.mark.fuzz
def test_both_readers_of_points_agree(tmp_path: Path, content: bytes) -> None:
    survives(READERS["points"], tmp_path, content)
