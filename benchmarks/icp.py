"""What refinement by ICP does to poses of an RGB-D sensor, judged by depth that it did not use.

    .venv/bin/python benchmarks/icp.py --scene ../shared/data/scenes/redkitchen_rgbd
    .venv/bin/python benchmarks/icp.py --root DIR --workspace W

The scene's ``make_depth.py`` writes it with depth, ``megloc eval kapture`` estimates the poses;
``--root`` and ``--workspace`` name what both wrote before. Half of every query's depth map, blocks
of 16 px like those of a chessboard, is hidden from ICP. The residual is the distance of those
pixels from the planes of the whole map's depth, made here without small_gicp: the median over the
pixels of a query that have map within 30 cm under all the poses compared, then over the queries.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

from megloc_kapture.evaluation.metrics import PoseErrors, pose_errors  # noqa: E402
from megloc_kapture.io.kapture import KaptureFolder  # noqa: E402
from megloc_kapture.io.tables import STATUS_FILE, read_status  # noqa: E402
from megloc_kapture.pipeline.executors import single_threaded  # noqa: E402
from megloc_kapture.plugins import DepthView, PoseRefinement  # noqa: E402
from megloc_kapture.refinement.icp import Icp, IcpOptions  # noqa: E402
from megloc_kapture.refinement.icp_surface import DepthCloudOptions, depth_cloud  # noqa: E402
from megloc_kapture.stages.scene import KaptureScene  # noqa: E402
from megloc_kapture.values import RigidTransform  # noqa: E402

Floats = NDArray[np.float64]
Poses = Mapping[str, RigidTransform]

BLOCK_PX = 16
VOXEL_M, NEIGHBOURS, FAR_M = 0.025, 20, 0.3
THRESHOLDS = ((0.025, 1.0), (0.05, 2.0), (0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
SETTINGS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("defaults", {}),
    ("5 references", {"max_references": 5}),
    ("20 references", {"max_references": 20}),
    ("depth up to 3 m", {"depth": {"max_depth_m": 3.0}}),
    ("edges kept", {"depth": {"max_jump": 1e9}}),
    ("one level", {"voxels_m": (0.025,), "max_distances_m": (0.075,)}),
)


class HalfHidden(KaptureScene):
    """A scene whose queries' depth is there on every other block only."""

    def query_depth(self, name: str) -> DepthView | None:
        """Depth of a query without the held-out pixels."""
        return half(super().query_depth(name), held_out=False)


def half(view: DepthView | None, *, held_out: bool) -> DepthView | None:
    """The blocks of a depth map that ICP sees, or the others."""
    if view is None:
        return None
    row, column = np.indices(view.depth_m.shape) // BLOCK_PX
    wanted = (row + column) % 2 == int(held_out)
    return replace(view, depth_m=np.where(wanted, view.depth_m, np.float32(0)))


@dataclass(frozen=True)
class MapPlanes:
    """All of a map's depth: a point per voxel, and the plane through those around it."""

    tree: Any
    points: Floats
    normals: Floats

    def distances(self, points: Floats) -> Floats:
        """Distance (N,) of points in the world from the planes; NaN where no map is near."""
        far, rows = self.tree.query(points, distance_upper_bound=FAR_M)
        near = np.isfinite(far)
        found = np.full(len(points), np.nan)
        offset = points[near] - self.points[rows[near]]
        found[near] = np.abs(np.einsum("ni,ni->n", offset, self.normals[rows[near]]))
        return found


def map_planes(mapping: KaptureFolder) -> MapPlanes:
    """Out of the depth of every mapping image."""
    scene = KaptureScene(mapping)
    clouds = []
    for name, pose in mapping.read().poses().items():
        view = scene.map_depth(name)
        if view is not None:
            clouds.append(voxel_means(pose.inverse().apply(depth_cloud(view))))
    points = voxel_means(np.concatenate(clouds))
    tree = cKDTree(points)
    _, rows = tree.query(points, NEIGHBOURS)
    around = points[rows] - points[rows].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return MapPlanes(tree, points, vectors[:, :, 0])


def voxel_means(points: Floats) -> Floats:
    """One point per voxel, the mean of those in it."""
    _, voxel, counts = np.unique(
        np.floor(points / VOXEL_M).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    sums = [np.bincount(voxel.reshape(-1), weights=points[:, k]) for k in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]


def residuals(planes: MapPlanes, points_in_cam: Floats, poses: Sequence[RigidTransform]) -> Floats:
    """Median distance in metres under each of several poses, over the same points."""
    distances = np.stack([planes.distances(pose.inverse().apply(points_in_cam)) for pose in poses])
    return np.median(distances[:, np.isfinite(distances).all(axis=0)], axis=1)


def recalls(errors: PoseErrors) -> list[str]:
    """Median errors and recall at the thresholds."""
    within = [
        100 * float(((errors.position_m <= m) & (errors.angle_deg <= deg)).mean())
        for m, deg in THRESHOLDS
    ]
    medians = [f"{np.median(errors.position_m):.4f}", f"{np.median(errors.angle_deg):.3f}"]
    return [*medians, *(f"{share:.1f}" for share in within)]


def measure(
    root: Path, workspace: Path, settings: Mapping[str, Any], planes: MapPlanes
) -> Measured:
    """Refine every query of a finished run."""
    query = KaptureFolder(root / "query")
    scene = HalfHidden(KaptureFolder(root / "mapping"), query)
    whole = KaptureScene(KaptureFolder(root / "mapping"), query)
    localized = KaptureFolder(workspace / "localized")
    truth = KaptureFolder(root / "query_gt").read().poses()
    statuses = read_status(workspace / "localized" / STATUS_FILE)
    refiner = Icp(IcpOptions.model_validate(settings))
    before, results, held_out, seconds = {}, {}, {}, []
    for name, pose in localized.read().poses().items():
        start = time.perf_counter()
        found = refiner.refine(
            name, query.read().camera_of(name), pose, statuses[name].candidates, scene
        )
        seconds.append(time.perf_counter() - start)
        before[name], results[name] = pose, found
        view = half(whole.query_depth(name), held_out=True)
        if view is not None and name in truth:
            points = depth_cloud(view, DepthCloudOptions())
            held_out[name] = residuals(planes, points, (pose, found.cam_from_world, truth[name]))
    return Measured(truth, before, results, held_out, float(np.mean(seconds)))


@dataclass(frozen=True)
class Measured:
    """What became of the queries; ``held_out`` are residuals before, after, and at the truth."""

    truth: Poses
    before: Poses
    results: Mapping[str, PoseRefinement]
    held_out: Mapping[str, Floats]
    seconds: float

    def row(self) -> list[str]:
        """Accepted, residuals of the accepted and of all in mm, errors, recalls, seconds."""
        accepted = [name for name in self.held_out if self.results[name].accepted]
        cells = [f"{100 * len(accepted) / len(self.results):.1f}"]
        for names in (accepted, list(self.held_out)):
            values = np.array([self.held_out[name] for name in names]).reshape(-1, 3)
            medians = 1e3 * np.median(values, axis=0) if len(values) else np.full(3, np.nan)
            cells += [f"{each:.2f}" for each in medians]
        refined = {name: found.cam_from_world for name, found in self.results.items()}
        return [*cells, *recalls(pose_errors(refined, self.truth)), f"{self.seconds:.2f}"]


def estimate(scene: Path, place: Path) -> tuple[Path, Path]:
    """Write the scene with depth and run the pipeline on it: root and workspace."""
    root, workspace = place / "scene", place / "workspace"
    subprocess.run([sys.executable, scene / "make_depth.py", root], check=True)
    command = [str(Path(sys.executable).with_name("megloc")), "eval", "kapture", "-q"]
    subprocess.run([*command, "--root", str(root), "--workspace", str(workspace)], check=True)
    return root, workspace


def report(root: Path, workspace: Path, *, all_settings: bool, verbose: bool) -> None:
    """Print the table."""
    planes = map_planes(KaptureFolder(root / "mapping"))
    header = ["", "accepted %", "before mm", "after", "truth", "all: before", "after", "truth"]
    header += ["med m", "med deg", *(f"{m:g} m {deg:g}" for m, deg in THRESHOLDS), "s"]
    rows = [header]
    for name, settings in SETTINGS if all_settings else SETTINGS[:1]:
        measured = measure(root, workspace, settings, planes)
        if len(rows) == 1:
            errors = pose_errors(measured.before, measured.truth)
            rows.append(["not refined", *["-"] * 7, *recalls(errors), "-"])
        rows.append([name, *measured.row()])
        for query, found in measured.results.items() if verbose else ():
            numbers = " ".join(f"{key} {value:.4f}" for key, value in found.measures.items())
            print(f"{query}: {found.reason or 'accepted'}; {numbers}", file=sys.stderr)
    print(table(rows))


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, help="folder with make_depth.py; else root")
    parser.add_argument("--root", type=Path, help="mapping/, query/ and query_gt/ with depth")
    parser.add_argument("--workspace", type=Path, help="of a finished run on it")
    parser.add_argument("--all", action="store_true", help="other options beside the defaults")
    parser.add_argument("--verbose", action="store_true", help="a line per query")
    arguments = parser.parse_args()
    if arguments.scene is None and None in (arguments.root, arguments.workspace):
        parser.error("give --scene, or --root and --workspace")
    options = {"all_settings": arguments.all, "verbose": arguments.verbose}
    with single_threaded(), tempfile.TemporaryDirectory(prefix="megloc-icp-") as place:
        root, workspace = arguments.root, arguments.workspace
        if arguments.scene is not None:
            root, workspace = estimate(arguments.scene.resolve(), Path(place))
        report(root, workspace, **options)


if __name__ == "__main__":
    main()
