"""Artefacts of a run of the preset ``megloc``, read with kapture's reader."""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from kapture.io.csv import kapture_from_dir
from kapture.io.features import (
    get_descriptors_fullpath,
    get_global_features_fullpath,
    get_keypoints_fullpath,
    get_matches_fullpath,
    image_descriptors_from_file,
    image_global_features_from_file,
    image_keypoints_from_file,
    image_matches_from_file,
)

from megloc_kapture.io.kapture import KaptureData, KaptureFolder, write_sensors
from megloc_kapture.pipeline.plan import read_manifest

# returns a description of the content of an artefact; raises if it is unreadable
Reader = Callable[[Path], str]

_FEATURES = {
    "local_features": ("keypoints", "descriptors", "matches"),
    "global_features": ("global_features",),
}


@dataclass(frozen=True)
class Artefact:
    """A file or folder that a stage wrote.

    Attributes
    ----------
    path : below the workspace.
    content : description, such as "18 images, 18 poses".
    seconds : duration of the stage.
    """

    stage: str
    path: str
    content: str
    seconds: float


def artefacts(workspace: Path) -> list[Artefact]:
    """Return all artefacts of a finished run in the order of the stages.

    Raises
    ------
    FileNotFoundError : a stage has not run or an artefact is missing.
    ValueError : an artefact is empty.
    """
    result = []
    for stage, readers in _ARTEFACTS.items():
        manifest = read_manifest(workspace / "stages" / f"{stage}.json")
        if manifest is None:
            raise FileNotFoundError(f"{stage}: the stage has not run")
        for name, read in readers.items():
            if not (workspace / name).exists():
                raise FileNotFoundError(f"{stage}: {name} is missing")
            result.append(Artefact(stage, name, read(workspace / name), manifest.seconds))
    return result


def read_features(root: Path, sensors_of: tuple[Path, ...]) -> dict[str, int]:
    """Count the rows that kapture reads for each kind and type of features.

    Parameters
    ----------
    root : folder in kapture-localization's layout, e.g. ``local_features/T/keypoints``.
    sensors_of : kapture folders that contain the images.
    """
    with tempfile.TemporaryDirectory(prefix="megloc-proxy-") as temporary:
        proxy = Path(temporary)
        _write_records(proxy, sensors_of)
        for folder, kinds in _FEATURES.items():
            for kind in kinds:
                for source in sorted(root.glob(f"{folder}/*/{kind}")):
                    link = proxy / "reconstruction" / kind / source.parent.name
                    link.parent.mkdir(parents=True, exist_ok=True)
                    link.symlink_to(source.resolve())
        return _rows(proxy)


def _write_records(proxy: Path, sensors_of: tuple[Path, ...]) -> None:
    """Merge the records of several folders; kapture requires them to read features."""
    data = KaptureData()
    for folder in sensors_of:
        read = KaptureFolder(folder).read()
        data.sensors.update(read.sensors)
        data.records_camera.update(read.records_camera)
    write_sensors(proxy, data)


def _rows(proxy: Path) -> dict[str, int]:
    root, data = str(proxy), kapture_from_dir(str(proxy))
    rows = {}
    for name, images in (data.keypoints or {}).items():
        rows[f"{name} keypoints"] = sum(
            len(
                image_keypoints_from_file(
                    get_keypoints_fullpath(name, root, image), images.dtype, images.dsize
                )
            )
            for image in images
        )
    for name, images in (data.descriptors or {}).items():
        rows[f"{name} descriptors"] = sum(
            len(
                image_descriptors_from_file(
                    get_descriptors_fullpath(name, root, image), images.dtype, images.dsize
                )
            )
            for image in images
        )
    for name, images in (data.global_features or {}).items():
        vectors = [
            image_global_features_from_file(
                get_global_features_fullpath(name, root, image), images.dtype, images.dsize
            )
            for image in images
        ]
        rows[f"{name} vectors"] = len(vectors)
    for name, pairs in (data.matches or {}).items():
        rows[f"{name} matches"] = sum(
            len(image_matches_from_file(get_matches_fullpath(pair, name, root))) for pair in pairs
        )
    return rows


def _folder(path: Path) -> str:
    data = kapture_from_dir(str(path))
    counts = {"images": len(data.records_camera.data_list())}
    if data.records_depth is not None:
        counts["depth maps"] = len(data.records_depth.data_list())
    if data.trajectories is not None:
        counts["poses"] = len(list(data.trajectories.key_pairs()))
    return _text(counts)


def _map(path: Path) -> str:
    data = kapture_from_dir(str(path))
    observed = 0 if data.observations is None else sum(len(o) for o in data.observations.values())
    points = 0 if data.points3d is None else len(data.points3d)
    return f"{_folder(path)}, {points} points, {observed} observed"


def _features(path: Path) -> str:
    workspace = next(parent for parent in path.parents if (parent / "stages").is_dir())
    sensors = tuple(workspace / "preprocessed" / part for part in ("mapping", "query"))
    root = path.parent if path.name in _FEATURES else path
    counts = read_features(root, sensors)
    if path.name in _FEATURES:  # the root also contains the other kind of features
        is_global = path.name == "global_features"
        counts = {name: n for name, n in counts.items() if name.endswith("vectors") == is_global}
    if not counts:
        raise ValueError(f"{path}: kapture reads no features")
    return _text(counts)


def _table(path: Path) -> str:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(line for line in file if not line.startswith("#")))
    return f"{max(len(rows) - 1, 0)} rows"


def _pairs(path: Path) -> str:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line]
    return f"{sum(not line.startswith('#') for line in lines)} pairs"


def _file(path: Path) -> str:
    if path.is_dir():
        return f"{sum(1 for file in path.rglob('*') if file.is_file())} files"
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty")
    return f"{path.stat().st_size} bytes"


def _text(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


_ARTEFACTS: dict[str, dict[str, Reader]] = {
    "import": {"mapping": _folder, "query": _folder, "query_gt": _folder, "megloc": _file},
    "preprocess": {
        "preprocessed/mapping": _folder,
        "preprocessed/query": _folder,
        "preprocessed/mapping/sensors/masks": _file,
    },
    "local_features": {"local_features": _features},
    "global_features": {"global_features": _features},
    "mapping_pairs": {"pairs/mapping.txt": _pairs},
    "mapping_matches": {"matches/mapping": _features},
    "mapping_rematching": {"pyramid/mapping": _features},
    "points": {"map_unrefined": _map},
    "map": {
        "map": _map,
        "map/reconstruction/refinement.json": _file,
        "map/reconstruction/point_covariances.npy": _file,
    },
    "query_candidates": {"pairs/query_candidates.txt": _pairs},
    "query_matches": {"matches/query": _features},
    "query_pairs": {"pairs/query.txt": _pairs},
    "query_rematching": {"pyramid/query": _features},
    "localization": {
        "localized_unrefined": _folder,
        "localized_unrefined/status.csv": _table,
        "localized_unrefined/clusters.csv": _table,
        "timing.csv": _table,
    },
    "refine_poses": {
        "localized": _folder,
        "localized/status.csv": _table,
        "localized/clusters.csv": _table,
        "localized/poses.csv": _table,
        "timing_refinement.csv": _table,
    },
    "submission": {"submissions": _file},
    "evaluation": {
        "evaluation/recall.json": _file,
        "evaluation/recall.txt": _file,
        "evaluation/per_query.csv": _table,
        "evaluation/report.html": _file,
        "evaluation/view.html": _file,
    },
}
