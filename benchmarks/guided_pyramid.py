"""Guided pyramid matching of queries that are turned, and too small or too large.

    MEGLOC_WEIGHTS=DIR .venv/bin/python benchmarks/guided_pyramid.py --features xfeat \\
        --scene DIR --scene DIR

A scene is a folder with mapping/, query/ and query_gt/ in kapture; cameras are pinholes. Its
queries are taken as they are, and changed: turned; turned and at a third of the size; turned, and
the middle third enlarged three times. Cameras and true poses change along. The map is triangulated
once; every query is matched with all map images, without the pyramid (off), and with it (all, max).

``--choose`` compares sets of scales and of turns on the same queries by mode ``all`` instead.
Plugins with options: ``--matcher '{name="superglue",options={weights="FILE"}}'``.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.csv_table import read_csv_table
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.io.kapture import (
    ImagePair,
    KaptureData,
    KaptureFolder,
    Sensor,
    write_sensors,
)
from megloc_kapture.matching.guided_pyramid import GuidedPyramidOptions, ImageVariant, pyramid_type
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    LocalFeatureExtractor,
    Matcher,
    PluginChoice,
)
from megloc_kapture.stages.guided_pyramid import COLUMNS, PyramidMethod, table_path
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import triangulate_map
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.pyramid_mapping import pyramid_mapping, pyramid_queries
from megloc_kapture.stages.query_poses import LocalizationOptions, localize_from_matches
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, Pose, RigidTransform

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

THRESHOLDS = ((0.05, 5.0), (0.25, 2.0))
WAYS: dict[str, GuidedPyramidOptions] = {
    "off": GuidedPyramidOptions(),
    "all": GuidedPyramidOptions(mode="all"),
    "max": GuidedPyramidOptions(mode="max"),
}
SETS: dict[str, GuidedPyramidOptions] = {
    "1/3 1/2 1 2 3, four turns": GuidedPyramidOptions(mode="all"),
    "1/2 1 2, four turns": GuidedPyramidOptions(mode="all", scales=(0.5, 1.0, 2.0)),
    "1/3 1 3, four turns": GuidedPyramidOptions(mode="all", scales=(1 / 3, 1.0, 3.0)),
    "1/4 1/3 1/2 0.7 1 1.4 2 3, four turns": GuidedPyramidOptions(
        mode="all", scales=(0.25, 1 / 3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
    ),
    "1/3 1/2 1 2 3, no turns": GuidedPyramidOptions(mode="all", rotations_deg=(0,)),
    "1, four turns": GuidedPyramidOptions(mode="all", scales=(1.0,)),
}


@dataclass(frozen=True)
class Change:
    """How queries are changed: the share of the image that is kept, its size after, its turn."""

    name: str
    kept: float = 1.0
    scale: float = 1.0
    rotation_deg: int = 0


CHANGES = (
    Change("as they are"),
    Change("turned by 90", rotation_deg=90),
    Change("turned, a third of the size", scale=1 / 3, rotation_deg=90),
    Change("turned, 3 times enlarged", kept=1 / 3, scale=3.0, rotation_deg=90),
)
# scales that no set has, too
CHOSEN_BY = (
    *CHANGES[2:],
    Change("turned, 0.42 of the size", scale=0.42, rotation_deg=90),
    Change("turned, 1.7 times enlarged", kept=1 / 1.7, scale=1.7, rotation_deg=90),
)


def changed_image(change: Change, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The middle of an image, scaled and turned."""
    height, width = image.shape[:2]
    left, top, kept_width, kept_height = _middle(change, width, height)
    middle = image[top : top + kept_height, left : left + kept_width]
    size = _scaled(change, kept_width, kept_height)
    how = cv2.INTER_AREA if change.scale < 1 else cv2.INTER_CUBIC
    scaled = np.asarray(cv2.resize(middle, size, interpolation=how), dtype=np.uint8)
    return ImageVariant(1.0, change.rotation_deg).of_image(scaled)


def changed_camera(change: Change, camera: Camera) -> tuple[Camera, RigidTransform]:
    """The camera of a changed image, and ``changed_from_camera``."""
    fx, fy, cx, cy = camera.params
    left, top, kept_width, kept_height = _middle(change, camera.width, camera.height)
    width, height = _scaled(change, kept_width, kept_height)
    sx, sy = width / kept_width, height / kept_height
    fx, fy, cx, cy = fx * sx, fy * sy, (cx - left) * sx, (cy - top) * sy
    if change.rotation_deg == 0:
        return Camera("PINHOLE", width, height, (fx, fy, cx, cy)), RigidTransform.identity()
    # counter-clockwise: what was to the right is at the top
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    camera = Camera("PINHOLE", height, width, (fy, fx, cy, width - cx))
    return camera, RigidTransform.from_matrix(turn, np.zeros(3))


def _middle(change: Change, width: int, height: int) -> tuple[int, int, int, int]:
    kept = round(width * change.kept), round(height * change.kept)
    return (width - kept[0]) // 2, (height - kept[1]) // 2, *kept


def _scaled(change: Change, width: int, height: int) -> tuple[int, int]:
    return round(width * change.scale), round(height * change.scale)


def write_queries(
    scene: Path, change: Change, root: Path, num_queries: int | None
) -> dict[str, RigidTransform]:
    """Write the first of the changed queries as kapture; their true poses by name."""
    source = KaptureFolder(scene / "query")
    truth = KaptureFolder(scene / "query_gt").read().poses()
    data, poses = KaptureData(), {}
    for timestamp, image in enumerate(source.read().image_names()[:num_queries]):
        name = f"changed_{Path(image).with_suffix('.png')}"
        camera, changed_from_camera = changed_camera(change, source.read().camera_of(image))
        data.sensors[f"cam{timestamp}"] = Sensor.from_camera(camera)
        data.records_camera[timestamp, f"cam{timestamp}"] = name
        poses[name] = changed_from_camera @ truth[image]
        pixels = changed_image(change, read_image_rgb(source.image_path(image)))
        write_image(root / "sensors" / "records_data" / name, pixels)
    write_sensors(root, data)
    return poses


@dataclass(frozen=True)
class Bench:
    """A scene's map, and what it is made with."""

    scene: Path
    root: Path
    extractor: LocalFeatureExtractor
    matcher: Matcher
    jobs: int
    map_options: GuidedPyramidOptions
    num_queries: int | None = None

    def mapping(self) -> KaptureFolder:
        return KaptureFolder(
            self.scene / "mapping", features_dirs=[self.root / "features", self.root / "pyramid"]
        )

    def make_map(self) -> None:
        local_type = self.extractor.name
        images = self.mapping().read().image_names()
        pairs = [ImagePair(a, b, 1.0) for a in images for b in images if a < b]
        with open_executor("processes", self.jobs) as executor:
            extract_local_features(
                [self.mapping()], self.extractor, self.root / "features", work=Work(executor)
            )
            match_pairs(
                self.mapping(), self.mapping(), pairs, local_type, self.matcher,
                KnownPoseOptions(), self.root / "features", work=Work(executor),
            )  # fmt: skip
            counts = pyramid_mapping(
                self.mapping(), pairs, local_type,
                PyramidMethod(self.extractor, self.matcher, KnownPoseOptions(), self.map_options),
                self.root / "pyramid", work=Work(executor),
            )  # fmt: skip
        points = triangulate_map(
            self.mapping(), self.mapping(), pyramid_type(local_type), self.root / "map",
            TriangulationOptions(),
        )  # fmt: skip
        print(f"{self.scene.name}: map {counts} {points}", file=sys.stderr)

    def measure(
        self, change: Change, ways: Mapping[str, GuidedPyramidOptions]
    ) -> list[tuple[str, ...]]:
        """A row for each way to match the changed queries."""
        local_type = self.extractor.name
        root = self.root / change.name.replace(" ", "_").replace(",", "")
        truth = write_queries(self.scene, change, root / "query", self.num_queries)
        features = root / "features"
        query = KaptureFolder(root / "query", features_dirs=[features])
        pairs = [
            ImagePair(image, other, 1.0)
            for image in sorted(truth)
            for other in self.mapping().read().image_names()
        ]
        rows = []
        with open_executor("processes", self.jobs) as executor:
            extract_local_features([query], self.extractor, features, work=Work(executor))
            match_pairs(
                query, self.mapping(), pairs, local_type, self.matcher, TwoViewOptions(), features,
                work=Work(executor),
            )  # fmt: skip
            for name, options in ways.items():
                output = root / name.replace(" ", "_").replace("/", "-").replace(",", "")
                counts = pyramid_queries(
                    query, self.mapping(), pairs, local_type,
                    PyramidMethod(self.extractor, self.matcher, TwoViewOptions(), options),
                    output, work=Work(executor),
                )  # fmt: skip
                found = self._localize(KaptureFolder(query.root, features_dirs=[output]), pairs)
                rows.append((change.name, name, *_figures(found, truth, counts)))
                print("  ".join((self.scene.name, *rows[-1])), file=sys.stderr)
                if options.mode != "off":
                    print(
                        f"   best variants: {_best(table_path(output, local_type))}",
                        file=sys.stderr,
                    )
        return rows

    def _localize(
        self, query: KaptureFolder, pairs: Sequence[ImagePair]
    ) -> dict[str, RigidTransform]:
        results = localize_from_matches(
            KaptureFolder(self.root / "map"), query, query, pairs,
            [pyramid_type(self.extractor.name)], LocalizationOptions(),
        )  # fmt: skip
        return {image: pose.cam_from_world for image, pose in results if isinstance(pose, Pose)}


def _best(path: Path) -> str:
    """How often each variant was the best of a pair."""
    count: dict[str, int] = {}
    for _, row in read_csv_table(path, COLUMNS):
        count[row["best_variant"]] = count.get(row["best_variant"], 0) + 1
    return ", ".join(f"{name or 'none'} {n}" for name, n in sorted(count.items()))


def _figures(
    found: Mapping[str, RigidTransform],
    truth: Mapping[str, RigidTransform],
    counts: Mapping[str, float],
) -> tuple[str, ...]:
    errors = []
    for image, pose in truth.items():
        if image not in found:
            errors.append((np.inf, np.inf))
            continue
        between = found[image] @ pose.inverse()
        angle = 2 * np.arccos(min(1.0, abs(between.quat_wxyz[0])))
        errors.append(
            (float(np.linalg.norm(found[image].center() - pose.center())), np.degrees(angle))
        )
    e = np.array(errors)
    recall = [((e[:, 0] <= m) & (e[:, 1] <= deg)).mean() for m, deg in THRESHOLDS]
    tried = int(counts["pairs_tried"])
    mean = [counts[key] / max(tried, 1) for key in ("matches_before", "matches_after")]
    return (
        str(len(truth)),
        f"{tried} of {counts['pairs']}",
        str(counts["pairs_gained"]),
        *(f"{each:.0f}" for each in mean),
        *(f"{100 * each:.0f}" for each in recall),
        f"{np.median(e[:, 0]):.3f}",
        f"{counts['seconds_per_tried_pair']:.2f}",
    )


HEADER = (
    "queries",
    "matching",
    "number",
    "pairs tried",
    "gained",
    "matches",
    "after",
    *(f"{m:g} m, {deg:g} deg" for m, deg in THRESHOLDS),
    "median m",
    "s per pair",
)


def plugin(text: str) -> PluginChoice:
    """A plugin from its name, or from an inline table of TOML."""
    given = tomllib.loads(f"plugin = {text}")["plugin"] if text.startswith("{") else text
    return PluginChoice.model_validate(given)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=lambda text: Path(text).resolve(), action="append")
    parser.add_argument("--features", type=plugin, default="xfeat")
    parser.add_argument("--matcher", type=plugin, default="nn")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--map-mode", choices=("off", "all", "max"), default="off")
    parser.add_argument("--choose", action="store_true")
    parser.add_argument("--change", choices=[c.name for c in CHANGES], action="append")
    parser.add_argument("--mode", choices=WAYS, action="append")
    parser.add_argument("--queries", type=int, help="the first so many only")
    parser.add_argument("--workspace", type=Path, help="keep what is made here")
    options = parser.parse_args()
    ways = (
        {"off": GuidedPyramidOptions(), **SETS}
        if options.choose
        else {name: way for name, way in WAYS.items() if name in (options.mode or WAYS)}
    )
    changes: Sequence[Change] = CHOSEN_BY if options.choose else CHANGES
    changes = [c for c in changes if options.change is None or c.name in options.change]
    extractor = load_plugin(LOCAL_FEATURES, options.features.name, options.features.options)
    matcher = load_plugin(MATCHERS, options.matcher.name, options.matcher.options)
    with tempfile.TemporaryDirectory(prefix="megloc-pyramid-") as temporary, single_threaded():
        for scene in options.scene:
            root = (options.workspace or Path(temporary)) / f"{scene.name}-{extractor.name}"
            map_options = GuidedPyramidOptions(mode=options.map_mode)
            bench = Bench(
                scene, root, extractor, matcher, options.jobs, map_options, options.queries
            )
            bench.make_map()
            rows = [row for change in changes for row in bench.measure(change, ways)]
            print(f"{os.linesep}{scene.name}, {extractor.name}{os.linesep}{table([HEADER, *rows])}")


if __name__ == "__main__":
    main()
