"""Importing a large NVM model as a kapture map: seconds and memory, and the same as kapture does.

    python benchmarks/speed/nvm_reading.py [--points 300000] [--cameras 1000]

The model is generated, the same bytes every time, and kept in the cache folder. RobotCar's merged
model (20,862 cameras, 6.8 M points, 36 M observations, 3 GB of text, twice that on disk with what
is written) is

    python benchmarks/speed/nvm_reading.py --points 6800000 --cameras 20862

The import runs in a process of its own, whose peak memory is what is reported. On a small model
kapture's own importer runs too, and poses, points and observations are compared; the script fails
if anything differs, or with ``--fail-above`` if the import takes more memory than that.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from timing import table

from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.values import Camera

WIDTH, HEIGHT = 1024, 1024
MEAN_TRACK_LENGTH = 5.3  # 36 M observations of 6.8 M points, as RobotCar's model has about
POINTS_AT_ONCE = 20_000
SMALL_POINTS, SMALL_CAMERAS = 20_000, 100
KEYPOINTS_TYPE = "sift"

IMPORT = """
import json, resource, sys, time
from pathlib import Path
import numpy as np
from megloc_kapture.datasets.formats.nvm import read_nvm
from megloc_kapture.datasets.reference_map import write_reference_map
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Camera

start, start_cpu = time.perf_counter(), time.process_time()
model = read_nvm(Path(sys.argv[1]))
read, read_cpu = time.perf_counter(), time.process_time()
width, height = int(sys.argv[3]), int(sys.argv[4])
data = KaptureData()
for index, name in enumerate(model.names):
    params = (model.focal_px[index], width / 2, height / 2, model.k_colmap[index])
    sensor = f"sensor{index}"
    camera = Camera("SIMPLE_RADIAL", width, height, params)
    data.sensors[sensor] = Sensor.from_camera(camera)
    data.trajectories[index, sensor] = model.cam_from_world(index)
    data.records_camera[index, sensor] = name
counts = write_reference_map(Path(sys.argv[2]), data, {}, model.names, model.points)
end, end_cpu = time.perf_counter(), time.process_time()
seconds = {"read_s": read - start, "read_cpu_s": read_cpu - start_cpu}
seconds |= {"write_s": end - read, "write_cpu_s": end_cpu - read_cpu}
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({**seconds, "peak_kib": peak, **counts}))
"""


def generate(path: Path, num_points: int, num_cameras: int) -> None:
    """Write a random model as COLMAP's exporter formats it; neighbouring images share points."""
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(num_cameras, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    centers = rng.normal(0.0, 1000.0, (num_cameras, 3))
    focals = rng.uniform(395.0, 405.0, num_cameras)
    distortions = rng.normal(0.0, 1e-3, num_cameras)
    # each image numbers its features upwards, with gaps
    next_feature = np.zeros(num_cameras, dtype=np.int64)
    temporary = path.with_suffix(".tmp")
    with temporary.open("w") as file:
        # COLMAP writes blanks into these lines, with which kapture's importer cannot do
        file.write(f"NVM_V3\n\n{num_cameras}\n")
        for index in range(num_cameras):
            values = [focals[index], *quats[index], *centers[index], distortions[index]]
            numbers = " ".join(f"{value:.12f}" for value in values)
            camera = ("left", "rear", "right")[index % 3]
            file.write(f"overcast-reference/{camera}/{1417176458999821 + index}.png {numbers} 0\n")
        file.write(f"\n{num_points}\n")
        for start in range(0, num_points, POINTS_AT_ONCE):
            file.write(points_text(rng, min(POINTS_AT_ONCE, num_points - start), next_feature))
    temporary.replace(path)


def points_text(
    rng: np.random.Generator, num_points: int, next_feature: np.ndarray[Any, Any]
) -> str:
    """Some lines of points, with features that no line before them has used."""
    num_cameras = len(next_feature)
    lengths = np.minimum(1 + rng.geometric(1 / (MEAN_TRACK_LENGTH - 1), num_points), num_cameras)
    ends = np.cumsum(lengths)
    points = np.repeat(np.arange(num_points), lengths)
    in_track = np.arange(ends[-1]) - (ends - lengths)[points]
    images = (rng.integers(0, num_cameras, num_points)[points] + in_track) % num_cameras
    order = np.argsort(images, kind="stable")
    of_image = np.bincount(images, minlength=num_cameras)
    rank = np.empty(len(images), np.int64)
    rank[order] = np.arange(len(images)) - (np.cumsum(of_image) - of_image)[images[order]]
    features = 3 * (next_feature[images] + rank) + rng.integers(0, 3, len(images))
    next_feature += of_image
    x, y = rng.uniform(0.0, WIDTH, (2, len(images)))
    values = [images.tolist(), features.tolist(), x.tolist(), y.tolist()]
    flat = tuple(value for row in zip(*values, strict=True) for value in row)
    measurements = ("%d %d %.12f %.12f\n" * len(images) % flat).split("\n")
    heads = np.column_stack([rng.normal(0.0, 1000.0, (num_points, 3)), np.zeros((num_points, 3))])
    heads[:, 3:] = rng.integers(0, 256, (num_points, 3))
    lines = []
    for head, begin, end in zip(
        heads.tolist(), (ends - lengths).tolist(), ends.tolist(), strict=True
    ):
        point = " ".join(f"{value:.12f}" for value in head[:3])
        colour = " ".join(f"{value:.0f}" for value in head[3:])
        lines.append(f"{point} {colour} {end - begin} {' '.join(measurements[begin:end])}\n")
    return "".join(lines)


def import_model(model: Path, output: Path) -> dict[str, Any]:
    """Read and write in a process of its own: seconds, peak memory and counts."""
    command = [sys.executable, "-c", IMPORT, str(model), str(output), str(WIDTH), str(HEIGHT)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout))


def import_with_kapture(model: Path, images: Path, output: Path) -> float:
    """Seconds of kapture's own importer. It opens every image for its size."""
    from kapture.io.records import TransferAction
    from tools.kapture_import_nvm import import_nvm  # type: ignore[import-untyped]

    start = time.perf_counter()
    import_nvm(
        str(model),
        str(images),
        str(output),
        None,
        False,
        True,
        True,
        TransferAction.skip,
    )
    return time.perf_counter() - start


def differences(ours: Path, theirs: Path) -> list[str]:
    """What differs between two kapture maps whose keypoints may be numbered differently."""
    first, second = KaptureFolder(ours), KaptureFolder(theirs)
    data, their_data = first.read(), second.read()
    found = []
    if cameras(data) != cameras(their_data):
        found.append("cameras")
    poses, their_poses = (np.array(pose_numbers(each)) for each in (data, their_data))
    if poses.shape != their_poses.shape or not np.allclose(poses, their_poses, rtol=0, atol=1e-9):
        found.append("poses")
    # kapture writes ten decimals
    if not np.allclose(first.points3d(), second.points3d(), rtol=0, atol=1e-9):
        found.append("points")
    if observed(first) != observed(second):
        found.append("observations")
    return found


def cameras(data: KaptureData) -> dict[str, Camera]:
    return {name: data.camera_of(name) for name in data.image_names()}


def pose_numbers(data: KaptureData) -> list[tuple[float, ...]]:
    return [(*pose.quat_wxyz, *pose.translation) for _, pose in sorted(data.poses().items())]


def observed(folder: KaptureFolder) -> list[tuple[Any, ...]]:
    """Every observation: point, image, x, y."""
    keypoints = folder.keypoints(KEYPOINTS_TYPE)
    observations = folder.observations()[KEYPOINTS_TYPE]
    places = [keypoints.read(name)[:, :2].tolist() for name in observations.image_names]
    rows = zip(
        observations.point_ids.tolist(),
        observations.image_ids.tolist(),
        observations.keypoint_ids.tolist(),
        strict=True,
    )
    names = observations.image_names
    return sorted((point, names[image], *places[image][k]) for point, image, k in rows)


def compare(cache: Path) -> tuple[float, float, list[str]]:
    """Seconds of kapture and of ours on a small model, and what differs."""
    with tempfile.TemporaryDirectory(dir=cache) as temporary:
        folder = Path(temporary)
        generate(folder / "small.nvm", SMALL_POINTS, SMALL_CAMERAS)
        for line in (folder / "small.nvm").read_text().split("\n")[3 : 3 + SMALL_CAMERAS]:
            image = folder / "images" / line.split()[0]
            image.parent.mkdir(parents=True, exist_ok=True)
            Image.new("L", (WIDTH, HEIGHT)).save(image, compress_level=1)
        theirs_s = import_with_kapture(folder / "small.nvm", folder / "images", folder / "theirs")
        ours = import_model(folder / "small.nvm", folder / "ours")
        different = differences(folder / "ours", folder / "theirs")
        return theirs_s, ours["read_s"] + ours["write_s"], different


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--points", type=int, default=300_000)
    parser.add_argument("--cameras", type=int, default=1_000)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "megloc-bench")
    parser.add_argument("--fail-above", type=float, default=8.0, help="largest peak accepted, GB")
    options = parser.parse_args()

    options.cache.mkdir(parents=True, exist_ok=True)
    model = options.cache / f"model_{options.points}_{options.cameras}.nvm"
    if not model.exists():
        start = time.perf_counter()
        generate(model, options.points, options.cameras)
        print(f"generated {model} in {time.perf_counter() - start:.0f} s")

    theirs_s, ours_s, different = compare(options.cache)  # compiles our loops if need be
    output = options.cache / "nvm_output"
    shutil.rmtree(output, ignore_errors=True)
    try:
        measured = import_model(model, output)
        written = sum(file.stat().st_size for file in output.rglob("*") if file.is_file())
    finally:
        shutil.rmtree(output, ignore_errors=True)

    peak_gb = measured["peak_kib"] * 1024 / 1e9
    print(
        f"{measured['images']} cameras, {measured['points']} points, "
        f"{measured['observations']} observations"
    )
    rows: list[Sequence[str]] = [("", "seconds", "processor seconds", "GB")]
    sizes = {"read": model.stat().st_size, "write": written}
    for step, size in sizes.items():
        seconds = [f"{measured[f'{step}{kind}']:.1f}" for kind in ("_s", "_cpu_s")]
        rows.append((step, *seconds, f"{size / 1e9:.2f}"))
    print(table(rows))
    print(f"peak memory of the process: {peak_gb:.2f} GB (accepted: {options.fail_above:g} GB)")
    print(f"{SMALL_CAMERAS} cameras, {SMALL_POINTS} points, both importers:")
    print(table([("kapture", f"{theirs_s:.2f} s"), ("ours", f"{ours_s:.2f} s")]))
    print(f"DIFFERENT: {', '.join(different)}" if different else "content equal")
    return 1 if different or peak_gb > options.fail_above else 0


if __name__ == "__main__":
    sys.exit(main())
