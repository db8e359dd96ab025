"""How the cost of mapping and localizing grows with the number of images: a planted world.

    python benchmarks/speed/scale.py [--images 200 400 800 1600] [--keypoints 500]

No image is rendered: a street of points (``street.py``) is seen by map images a metre apart and by
a tenth as many queries, and keypoints, descriptors and global features are written as kapture has
them. Half of an image's keypoints see points, whose descriptors differ between images by noise. The
number of pairs per image is the same at all sizes.

Every stage runs in this process, on one core, after a small world that is not counted. The fitted
exponent is that of processor seconds in the number of images; above ``--most`` it fails. Hours on
more cores are those of the stages that are divided among them, times what an executor costs
(``--overhead``, see ``executors.py``), and of the others on one.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from street import CAMERA, Street, in_view, make_street, pose_near  # noqa: E402
from timing import peak_gib, table  # noqa: E402

from megloc_kapture.geometry.cameras import project  # noqa: E402
from megloc_kapture.io.colmap import TriangulationOptions  # noqa: E402
from megloc_kapture.io.kapture import (  # noqa: E402
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureData,
    KaptureFolder,
    Sensor,
    write_sensors,
)
from megloc_kapture.io.kapture.features import ArrayKind  # noqa: E402
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours  # noqa: E402
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions  # noqa: E402
from megloc_kapture.pipeline.executors import single_threaded  # noqa: E402
from megloc_kapture.stages.candidates import QueryPairsOptions, Retrieval  # noqa: E402
from megloc_kapture.stages.image_pairs import (  # noqa: E402
    MappingPairsOptions,
    pair_map_images,
    pair_queries,
)
from megloc_kapture.stages.map_points import triangulate_map  # noqa: E402
from megloc_kapture.stages.matches import match_pairs  # noqa: E402
from megloc_kapture.stages.query_poses import (  # noqa: E402
    LocalizationOptions,
    localize_from_matches,
)
from megloc_kapture.values import Pose, RigidTransform  # noqa: E402

TYPE = "planted"
PAIRS = 10  # of each image
GLOBAL = 256  # values of a global feature
DIVIDED = ("match map", "match queries", "localization")
SEEN_BY = 5  # images that see a point
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class World:
    """A written world: kapture folders of map and queries, and the queries' true poses."""

    root: Path
    street: Street
    truth: dict[str, RigidTransform]


def write_world(root: Path, num_images: int, num_keypoints: int, num_parts: int = 1) -> World:
    """Write ``mapping/`` and ``query/`` with features below a folder."""
    seen = num_keypoints // 2
    num_points = num_images * seen // SEEN_BY
    street = make_street(num_images, num_points, seen, num_keypoints, num_parts)
    rng = np.random.default_rng(5)
    descriptors = _unit(rng.normal(size=(len(street.xyz), 128)))

    def features(names: list[str], poses: list[RigidTransform], folder: str, views: Any) -> None:
        data = KaptureData(sensors={"camera": Sensor.from_camera(CAMERA)})
        configs: dict[ArrayKind, FeatureConfig] = {
            "keypoints": FeatureConfig(TYPE, np.dtype("float32"), 2),
            "descriptors": FeatureConfig(TYPE, np.dtype("float32"), 128, TYPE, "L2"),
            "global_features": FeatureConfig(TYPE, np.dtype("float32"), GLOBAL, None, "L2"),
        }
        writers = [FeatureWriter(root / folder, kind, TYPE, one) for kind, one in configs.items()]
        for at, (name, pose) in enumerate(zip(names, poses, strict=True)):
            data.records_camera[at + (folder == "query") * 10**6, "camera"] = name
            if folder == "mapping":
                data.trajectories[at, "camera"] = pose
            px, rows, points = views(at)
            of_image = rng.normal(size=(num_keypoints, 128)).astype(np.float32)
            of_image[rows] = 20.0 * descriptors[points] + 0.8 * of_image[rows]
            arrays = (px, _unit(of_image), _global(pose))
            for writer, array in zip(writers, arrays, strict=True):
                writer.write(name, array)
        write_sensors(root / folder, data)

    features(
        list(street.names),
        list(street.poses),
        "mapping",
        lambda i: (street.keypoints_px(i), street.keypoints_of_seen(i), street.seen(i)),
    )
    near_of = rng.integers(0, num_images, max(5, num_images // 10)).tolist()
    places = [pose_near(street, rng, near) for near in near_of]
    truth = {f"query/{i:06d}.jpg": pose for i, pose in enumerate(places)}

    def query(at: int) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
        points = street.seen(near_of[at])
        points = points[in_view(places[at], street.xyz[points])]
        px = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (num_keypoints, 2))
        rows = rng.permutation(num_keypoints)[: len(points)]
        px[rows] = project(CAMERA, places[at], street.xyz[points])
        return px.astype(np.float32), rows, points

    features(list(truth), places, "query", query)
    return World(root, street, truth)


def _unit(rows: NDArray[np.floating]) -> Floats:
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True), np.float32)


def _global(pose: RigidTransform) -> Floats:
    """Random Fourier features of the place: similar within some metres, else not."""
    rng = np.random.default_rng(6)
    frequencies, phases = rng.normal(0, 0.3, GLOBAL), rng.uniform(0, 2 * np.pi, GLOBAL)
    return _unit(np.cos(frequencies * pose.center()[0] + phases))


def run(world: World) -> tuple[dict[str, tuple[float, float]], float]:
    """Processor seconds and peak GiB of each stage, and the share of queries within 5 cm."""
    spent: dict[str, tuple[float, float]] = {}

    def stage(name: str, work: Callable[[], Any]) -> Any:
        peak_gib(reset=True)
        start = time.process_time()
        found = work()
        spent[name] = (time.process_time() - start, peak_gib())
        return found

    mapping, query = (KaptureFolder(world.root / name) for name in ("mapping", "query"))
    retrieval, matches = Retrieval((TYPE,)), world.root / "matches"
    by = MappingPairsOptions(by=("retrieval",), top_k=PAIRS)
    pairs = stage("map pairs", lambda: pair_map_images(mapping, by, retrieval=retrieval))
    few = QueryPairsOptions(top_k=PAIRS)
    asked = stage("query pairs", lambda: pair_queries(mapping, query, few, retrieval=retrieval))

    def matched(second: KaptureFolder, wanted: list[ImagePair], how: Any) -> KaptureFolder:
        match_pairs(second, mapping, wanted, TYPE, NearestNeighbours(), how, matches)
        return KaptureFolder(second.root, features_dirs=[matches])

    of_map = stage("match map", lambda: matched(mapping, pairs, KnownPoseOptions()))
    of_query = stage("match queries", lambda: matched(query, asked, TwoViewOptions()))
    place = world.root / "map"
    stage(
        "triangulation",
        lambda: triangulate_map(mapping, of_map, TYPE, place, TriangulationOptions()),
    )
    found = stage(
        "localization",
        lambda: list(
            localize_from_matches(
                KaptureFolder(place), of_query, of_query, asked, [TYPE], LocalizationOptions()
            )
        ),
    )
    right = 0
    for name, result in found:
        if isinstance(result, Pose):
            off = result.cam_from_world.center() - world.truth[name].center()
            right += bool(np.linalg.norm(off) < 0.05)
    return spent, right / len(found)


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """Slope of the line through the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(np.maximum(seconds, 1e-3)), 1)[0])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--images", type=int, nargs="+", default=[200, 400, 800, 1600])
    parser.add_argument("--keypoints", type=int, default=500)
    parser.add_argument("--parts", type=int, default=1, help="streets that do not meet")
    parser.add_argument("--overhead", type=float, default=1.1, help="times, of an executor")
    parser.add_argument("--target", type=int, default=26_121, help="images that hours are for")
    parser.add_argument("--most", type=float, default=1.1, help="exponent of any stage")
    given = parser.parse_args()
    measured = {}
    with single_threaded():
        for count in (40, *given.images):
            with tempfile.TemporaryDirectory() as folder:
                parts = 1 if count == 40 else given.parts
                measured[count] = run(write_world(Path(folder), count, given.keypoints, parts))
            if count != 40:
                steps = ", ".join(
                    f"{k} {s:.1f} s {g:.2f} GiB" for k, (s, g) in measured[count][0].items()
                )
                print(f"{count}: {steps}; {100 * measured[count][1]:.0f} % within 5 cm", flush=True)
    sizes = sorted(given.images)
    header = ("processor s", *(f"{n} images" for n in sizes), "exponent", "GiB at most")
    rows, missed, hours = [header], False, {}
    for name in measured[sizes[0]][0]:
        seconds = [measured[n][0][name][0] for n in sizes]
        slope = exponent(sizes, seconds)
        # what takes less than a second is the clock's and the file system's noise
        missed |= slope > given.most and seconds[-1] > 1.0
        hours[name] = seconds[-1] * (given.target / sizes[-1]) ** max(slope, 1.0) / 3600
        peak = max(measured[n][0][name][1] for n in sizes)
        rows.append((name, *(f"{s:.2f}" for s in seconds), f"{slope:.2f}", f"{peak:.2f}"))
    print(table(rows))
    alone = sum(spent for name, spent in hours.items() if name not in DIVIDED)
    divided = sum(spent for name, spent in hours.items() if name in DIVIDED)
    for cores in (1, 8, 64, 512):
        times = given.overhead if cores > 1 else 1.0
        total = alone + times * divided / cores
        print(
            f"{given.target} images on {cores} cores: {total:.2f} hours, of them {alone:.2f} alone"
        )
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
