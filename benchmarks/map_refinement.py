"""What map refinement removes from a map, and what that does to points and to localization.

    .venv/bin/python benchmarks/map_refinement.py world
    .venv/bin/python benchmarks/map_refinement.py depth --root DIR --workspace W

``world`` builds rooms whose points and cameras are known exactly. Keypoints have a noise of 1 px;
three in ten matches lead to another keypoint, one that known poses cannot tell from the right one.
The map is triangulated as always and refined in several ways; means over the seeds.

``depth`` takes a folder with mapping/, query/ and query_gt/ in kapture, where mapping images and
queries have depth maps, and the workspace of ``megloc eval kapture --root DIR --workspace W``. It
compares the map's points with the depth of the queries, which had no part in the map, and localizes
the queries again in the refined maps.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

from megloc_kapture.geometry.cameras import bearing_rays, project, px_from_cam  # noqa: E402
from megloc_kapture.io.colmap import MapImage, TriangulationOptions, triangulate  # noqa: E402
from megloc_kapture.io.images import read_depth_map  # noqa: E402
from megloc_kapture.io.kapture import (  # noqa: E402
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    KaptureFolder,
    Observations,
    Sensor,
    read_pairs,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.points import read_point_covariances  # noqa: E402
from megloc_kapture.localization.absolute_pose import absolute_pose  # noqa: E402
from megloc_kapture.matching.verification import (  # noqa: E402
    KnownPoseOptions,
    ray_slopes,
    verify_with_poses,
)
from megloc_kapture.pipeline.executors import single_threaded  # noqa: E402
from megloc_kapture.pipeline.presets import options_of_preset  # noqa: E402
from megloc_kapture.stages.map_refinement import MapRefinementOptions, refine_map  # noqa: E402
from megloc_kapture.stages.query_poses import localize_from_matches  # noqa: E402
from megloc_kapture.stages.scene import depth_records  # noqa: E402
from megloc_kapture.values import Camera, Pose, RigidTransform  # noqa: E402

Floats = NDArray[np.float64]
Ids = NDArray[np.int64]

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
ROOM_M = np.array([16.0, 4.0, 16.0])
NUM_POINTS, NUM_IMAGES, NUM_QUERIES = 4000, 60, 100
NOISE_PX, CORRUPTED, DETECTED = 1.0, 0.3, 0.6
MATCHES_PER_QUERY = 60
# finer than a dataset's: the rooms are easy, and what is lost shows where poses are exact
THRESHOLDS = ((0.01, 0.1), (0.02, 0.2), (0.05, 5.0), (0.25, 2.0))
LOCALIZED_AT = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
TYPE = "exact"

WORLD_SETTINGS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("not refined", {"depth": {"max_sigmas": None}}),
    ("defaults", {}),
    ("2 robust sigmas", {"uncertainty": {"max_robust_sigmas": 2.0}}),
    ("2.5 robust sigmas", {"uncertainty": {"max_robust_sigmas": 2.5}}),
    ("3 robust sigmas", {"uncertainty": {"max_robust_sigmas": 3.0}}),
    ("4 robust sigmas", {"uncertainty": {"max_robust_sigmas": 4.0}}),
)


# ---------------------------------------------------------------------------------------- world


@dataclass(frozen=True, eq=False)
class Taken:
    """An image: its pose, keypoints (K, 2), and the point that each of them shows (K,)."""

    cam_from_world: RigidTransform
    keypoints_px: NDArray[np.float32]
    shown: Ids


def room(rng: np.random.Generator) -> Floats:
    """Points on the walls, floor and ceiling of a room; (N, 3)."""
    points = rng.random((NUM_POINTS, 3))
    axis = rng.choice(3, NUM_POINTS, p=[0.35, 0.3, 0.35])
    points[np.arange(NUM_POINTS), axis] = rng.integers(0, 2, NUM_POINTS)
    return points * ROOM_M


def take(rng: np.random.Generator, points: Floats) -> Taken:
    """An image from somewhere in the room's inner half."""
    center = ROOM_M * (0.25 + 0.5 * rng.random(3))
    angles = (rng.normal(0, 5), rng.uniform(0, 360), rng.normal(0, 2))
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    pose = RigidTransform.from_matrix(rotation, -rotation @ center)
    pixels = project(CAMERA, pose, points)
    size = (CAMERA.width, CAMERA.height)
    with np.errstate(invalid="ignore"):
        seen = (pixels > 0).all(axis=1) & (pixels < size).all(axis=1)
    shown = np.flatnonzero(seen & (rng.random(len(points)) < DETECTED))
    noisy = pixels[shown] + rng.normal(0, NOISE_PX, (len(shown), 2))
    return Taken(pose, noisy.astype(np.float32), shown)


def match(rng: np.random.Generator, a: Taken, b: Taken) -> tuple[Ids, int]:
    """Matches (M, 2) that pass verification with the known poses, and how many are wrong."""
    _, rows_a, rows_b = np.intersect1d(a.shown, b.shown, return_indices=True)
    rays_a, rays_b = bearing_rays(CAMERA, a.keypoints_px), bearing_rays(CAMERA, b.keypoints_px)
    slopes_a = ray_slopes(CAMERA, a.keypoints_px, rays_a)
    slopes_b = ray_slopes(CAMERA, b.keypoints_px, rays_b)
    b_from_a = b.cam_from_world @ a.cam_from_world.inverse()
    matched = rows_b.copy()
    for place in np.flatnonzero(rng.random(len(rows_a)) < CORRUPTED):
        row = np.full(len(rays_b), rows_a[place])
        alike = verify_with_poses(
            rays_a[row], slopes_a[row], rays_b, slopes_b, b_from_a, KnownPoseOptions(min_matches=0)
        )
        alike[rows_b[place]] = False
        others = np.flatnonzero(alike)
        if len(others):
            matched[place] = rng.choice(others)
    # mutual nearest neighbours use a keypoint once: the wrong match takes it from the right one
    order = np.argsort(matched == rows_b, kind="stable")
    _, first = np.unique(matched[order], return_index=True)
    rows_a, matched = rows_a[order[first]], matched[order[first]]
    good = verify_with_poses(
        rays_a[rows_a], slopes_a[rows_a], rays_b[matched], slopes_b[matched], b_from_a
    )
    pairs = np.stack([rows_a[good], matched[good]], axis=1)
    return pairs, int((a.shown[pairs[:, 0]] != b.shown[pairs[:, 1]]).sum())


def write_map(root: Path, images: Sequence[Taken], matches: Mapping[tuple[int, int], Ids]) -> None:
    """Triangulate as the pipeline does, and write the map."""
    names = [f"{row:03d}.png" for row in range(len(images))]
    found = triangulate(
        [
            MapImage(name, CAMERA, image.cam_from_world, image.keypoints_px)
            for name, image in zip(names, images, strict=True)
        ],
        matches,
        TriangulationOptions(),
    )
    data = KaptureData(sensors={"camera": Sensor.from_camera(CAMERA)})
    for row, image in enumerate(images):
        data.records_camera[row, "camera"] = names[row]
        data.trajectories[row, "camera"] = image.cam_from_world
    write_sensors(root, data)
    config = FeatureConfig("exact", np.dtype(np.float32), 2)
    with FeatureWriter(root, "keypoints", TYPE, config) as writer:
        for name, image in zip(names, images, strict=True):
            writer.write(name, image.keypoints_px)
    write_points3d(root, found.xyz)
    seen = Observations(
        TYPE,
        tuple(names),
        found.point_ids,
        found.image_ids.astype(np.int32),
        found.keypoint_ids.astype(np.int32),
    )
    write_observations(root, {TYPE: seen})


def points_shown(root: Path, images: Sequence[Taken]) -> Ids:
    """Which of the room's points each point of the map is: what most of its observations show."""
    folder = KaptureFolder(root)
    seen = folder.observations()[TYPE]
    named = [images[int(name.removesuffix(".png"))] for name in seen.image_names]
    shown = np.array(
        [
            named[image].shown[keypoint]
            for image, keypoint in zip(seen.image_ids, seen.keypoint_ids, strict=True)
        ],
        dtype=np.int64,
    )
    pairs, votes = np.unique(np.stack([seen.point_ids, shown]), axis=1, return_counts=True)
    order = np.lexsort((-votes, pairs[0]))
    ids, first = np.unique(pairs[0][order], return_index=True)
    identity = np.full(len(folder.points3d()), -1)
    identity[ids] = pairs[1][order][first]
    return identity


def query_errors(
    rng: np.random.Generator, query: Taken, folder: KaptureFolder, identity: Ids, number: Ids
) -> tuple[float, float]:
    """Error of the pose found (m, deg) from matches of which some lead to another point.

    The points' covariances count, as in the pipeline. ``number`` orders the
    keypoints: all maps are asked for the same ones first.
    """
    xyz = folder.points3d()[:, :3]
    row_of = {int(point): row for row, point in enumerate(identity)}
    known = [k for k in number if int(query.shown[k]) in row_of][:MATCHES_PER_QUERY]
    rows = np.array([row_of[int(query.shown[k])] for k in known], dtype=np.int64)
    wrong = rng.random(len(rows)) < CORRUPTED
    rows[wrong] = rng.integers(0, len(xyz), int(wrong.sum()))
    covariances = read_point_covariances(folder.root, len(xyz))
    found = absolute_pose(
        query.keypoints_px[known],
        xyz[rows],
        CAMERA,
        point_covariances=None if covariances is None else covariances[rows],
    )
    if not isinstance(found, Pose):
        return np.inf, 180.0
    return pose_error(found.cam_from_world, query.cam_from_world)


def pose_error(pose: RigidTransform, truth: RigidTransform) -> tuple[float, float]:
    """Distance of the centres and angle between the orientations, degrees."""
    turn = Rotation.from_matrix(pose.rotation_matrix() @ truth.rotation_matrix().T)
    distance = np.linalg.norm(pose.center() - truth.center())
    return float(distance), float(np.degrees(turn.magnitude()))


def recalls(
    errors: Sequence[tuple[float, float]], thresholds: Sequence[tuple[float, float]]
) -> list[float]:
    """Median errors, then recall at the thresholds."""
    measured = np.array(errors)
    within = [float(((measured <= limit).all(axis=1)).mean()) for limit in thresholds]
    return [*np.median(measured, axis=0).tolist(), *within]


def measure_room(seed: int, place: Path) -> list[list[float]]:
    """A row of figures for each of the settings."""
    rng = np.random.default_rng(seed)
    points = room(rng)
    images = [take(rng, points) for _ in range(NUM_IMAGES)]
    queries = [take(rng, points) for _ in range(NUM_QUERIES)]
    orders = [rng.permutation(len(query.shown)) for query in queries]
    matches, wrong = {}, 0
    for a in range(NUM_IMAGES):
        for b in range(a + 1, NUM_IMAGES):
            pairs, num_wrong = match(rng, images[a], images[b])
            if len(pairs):
                matches[a, b] = pairs
                wrong += num_wrong
    write_map(place / "map", images, matches)
    wrong_share = wrong / sum(map(len, matches.values()))
    rows = []
    for name, settings in WORLD_SETTINGS:
        refined = place / name
        refine_map(
            KaptureFolder(place / "map"), refined, MapRefinementOptions.model_validate(settings)
        )
        folder = KaptureFolder(refined)
        xyz = folder.points3d()[:, :3]
        identity = points_shown(refined, images)
        errors_m = np.linalg.norm(xyz - points[identity], axis=1)
        found = [
            query_errors(np.random.default_rng([seed, row]), query, folder, identity, orders[row])
            for row, query in enumerate(queries)
        ]
        within = [float((errors_m <= limit).mean()) for limit in (0.02, 0.05)]
        rows.append([wrong_share, float(len(xyz)), *within, *recalls(found, THRESHOLDS)])
    return rows


def world(seeds: Sequence[int]) -> str:
    """The table of means over the seeds."""
    measured = []
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="megloc-refinement-") as folder:
            measured.append(measure_room(seed, Path(folder)))
    means = np.mean(measured, axis=0)
    before = means[0]
    header = ["", "points", "of all", "in 2 cm", "in 5 cm", "med m", "med deg"]
    rows = [[*header, *(f"{m:g} m {deg:g}" for m, deg in THRESHOLDS)]]
    for (name, _), mean in zip(WORLD_SETTINGS, means, strict=True):
        cells = [f"{mean[1]:.0f}", f"{mean[1] / before[1]:.3f}", f"{mean[2]:.3f}", f"{mean[3]:.3f}"]
        cells += [f"{mean[4]:.4f}", f"{mean[5]:.3f}", *(f"{100 * r:.1f}" for r in mean[6:])]
        rows.append([name, *cells])
    return (
        f"{len(seeds)} rooms; {100 * before[0]:.1f} % of the matches that are triangulated are "
        f"wrong\n{table(rows)}"
    )


# ---------------------------------------------------------------------------------------- depth


def held_out(root: Path, query: KaptureFolder, truth: KaptureFolder) -> tuple[float, float, float]:
    """Shares of a map's points within 2 cm and 5 cm of the queries' depth, and in free space.

    Of the points that a query sees, counted once for each query: those more than 30 cm behind its
    depth may be hidden and do not count. Free space is more than 10 cm in front.
    """
    xyz = KaptureFolder(root).points3d()[:, :3]
    data, poses, records = query.read(), truth.read().poses(), depth_records(query.read())
    behind: list[Floats] = []
    for image in sorted(set(poses) & set(records)):
        record = records[image]
        depth_camera = record.camera
        depth_m = read_depth_map(
            query.depth_path(record.path), width=depth_camera.width, height=depth_camera.height
        )
        in_image = poses[image].apply(xyz)
        pixels = px_from_cam(data.camera_of(image), in_image)
        in_depth = record.image_from_depth.inverse().apply(in_image)
        at = px_from_cam(depth_camera, in_depth)
        with np.errstate(invalid="ignore"):
            seen = (pixels > 0).all(axis=1) & (pixels < _size(data.camera_of(image))).all(axis=1)
            seen &= (at > 0).all(axis=1) & (at < _size(depth_camera)).all(axis=1)
        column, line = at[seen].astype(int).T
        depth = depth_m[line, column].astype(np.float64)
        behind.append((in_depth[seen, 2] - depth)[depth > 0])
    difference = np.concatenate(behind)
    difference = difference[difference < 0.3]
    near = [float((np.abs(difference) < limit).mean()) for limit in (0.02, 0.05)]
    return near[0], near[1], float((difference < -0.1).mean())


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


DEPTH_SETTINGS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("not refined", {"depth": {"max_sigmas": None}}),
    ("defaults (3 sigmas)", {}),
    ("10 sigmas", {"depth": {"max_sigmas": 10.0}}),
    ("5 sigmas", {"depth": {"max_sigmas": 5.0}}),
    ("2 sigmas", {"depth": {"max_sigmas": 2.0}}),
    ("5 sigmas of the sensor", {"depth": {"keypoint_noise_px": 0.0, "max_sigmas": 5.0}}),
    ("20 sigmas of the sensor", {"depth": {"keypoint_noise_px": 0.0, "max_sigmas": 20.0}}),
)


def depth(root: Path, workspace: Path, seeds: Sequence[int], assignments: Sequence[str]) -> str:
    """The table of a finished workspace; medians and recalls are means over the seeds."""
    options = options_of_preset(assignments=assignments)
    local_type = options.main_type()
    query = KaptureFolder(
        workspace / "query", features_dirs=[workspace, workspace / "matches" / "query"]
    )
    truth = KaptureFolder(workspace / "query_gt")
    true_poses = truth.read().poses()
    pairs = read_pairs(workspace / "pairs" / "query.txt")
    header = ["", "points", "observations", "in 2 cm", "in 5 cm", "free", "med m", "med deg"]
    rows = [[*header, *(f"{m:g} m {deg:g}" for m, deg in LOCALIZED_AT)]]
    for name, settings in DEPTH_SETTINGS:
        with tempfile.TemporaryDirectory(prefix="megloc-refinement-", dir=workspace) as folder:
            refined = Path(folder) / "map"
            counts = refine_map(
                KaptureFolder(workspace / "map"),
                refined,
                MapRefinementOptions.model_validate(settings),
                link_features=True,
            )
            measured = []
            for seed in seeds:
                pose = options.localization.pose.model_copy(update={"seed": seed})
                found = localize_from_matches(
                    KaptureFolder(refined),
                    query,
                    query,
                    pairs,
                    [local_type],
                    options.localization.model_copy(update={"pose": pose}),
                )
                errors = [
                    pose_error(result.cam_from_world, true_poses[image])
                    if isinstance(result, Pose)
                    else (np.inf, 180.0)
                    for image, result in found
                    if image in true_poses
                ]
                measured.append(recalls(errors, LOCALIZED_AT))
            mean = np.mean(measured, axis=0)
            near = held_out(refined, KaptureFolder(root / "query"), truth)
        cells = [f"{counts['points']:.0f}", f"{counts['observations']:.0f}"]
        cells += [*(f"{share:.3f}" for share in near), f"{mean[0]:.4f}", f"{mean[1]:.3f}"]
        rows.append([name, *cells, *(f"{100 * r:.1f}" for r in mean[2:])])
        print(rows[-1], file=sys.stderr)
    return table(rows)


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("world", "depth"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--root", type=Path, help="dataset with depth maps (depth)")
    parser.add_argument("--workspace", type=Path, help="of a finished run on it (depth)")
    parser.add_argument("--set", action="append", default=[], help="option of the localization")
    arguments = parser.parse_args()
    if arguments.what == "depth" and None in (arguments.root, arguments.workspace):
        parser.error("depth needs --root and --workspace")
    with single_threaded():
        if arguments.what == "world":
            print(world(arguments.seeds))
        else:
            print(depth(arguments.root, arguments.workspace, arguments.seeds, arguments.set))


if __name__ == "__main__":
    main()
