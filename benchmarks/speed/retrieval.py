"""Compare retrieval from kapture's files with a matrix product and kapture-localization.

    .venv/bin/python benchmarks/speed/retrieval.py [--million]

Task: the top 50 of 1,000 queries in 10,000 images with 4096 dimensions. The vectors are in the page
cache, either in one tar or in one file per image. The matrix product alone, from memory and without
ranking, is the lower bound of an exact search. All methods run alternately in this process with the
same threads. Ours and kapture-localization are timed for the search alone (from opening the vectors
to the ranking) and for the whole tool (from kapture folders to the pairs file), and their pairs are
compared. ``--million`` searches a million vectors, generated in blocks, in a separate process and
prints the peak memory.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import resource
import runpy
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from kloc_tools import tool_scripts
from numpy.typing import NDArray
from timing import table

from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureData,
    KaptureFolder,
    Sensor,
    read_pairs,
    write_pairs,
    write_sensors,
)
from megloc_kapture.io.kapture.features import KaptureVectors, feature_folder
from megloc_kapture.retrieval.search import FusionOptions, rank_rows
from megloc_kapture.values import Camera, RigidTransform

TYPE = "generated"
CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
SCORE_TOLERANCE = 1e-6
MILLION = 1_000_000
Vectors = NDArray[np.float32]
Pairs = dict[str, dict[str, float]]


def random_vectors(seed: Sequence[int], count: int, dimension: int) -> Vectors:
    """Generate random unit vectors (count, dimension)."""
    rng = np.random.default_rng(seed)
    rows: Vectors = rng.standard_normal((count, dimension), dtype=np.float32)
    rows /= np.sqrt(np.vecdot(rows, rows))[:, None]
    return rows


def generate(
    folder: Path, names: Sequence[str], vectors: Iterable[Vectors], dimension: int, *, tar: bool
) -> None:
    """Write a kapture folder with global features unless it exists."""
    if (folder / "complete").exists():
        return
    data = KaptureData(sensors={"camera": Sensor.from_camera(CAMERA)})
    for timestamp, name in enumerate(names):
        data.records_camera[timestamp, "camera"] = name
        data.trajectories[timestamp, "camera"] = RigidTransform.identity()
    write_sensors(folder, data)
    config = FeatureConfig(TYPE, np.dtype("float32"), dimension, None, "L2")
    writer = FeatureWriter(folder, "global_features", TYPE, config)
    for name, vector in zip(names, vectors, strict=True):
        if name not in writer:
            writer.write(name, vector)
    if tar:
        pack(feature_folder(folder, "global_features", TYPE, orphan=False))
    (folder / "complete").touch()


def pack(folder: Path) -> None:
    """Move the global features of a folder into a tar, kapture's format for large sets."""
    with tarfile.open(folder / "global_features.tar", "w") as tar:
        for path in sorted(folder.rglob("*.gfeat")):
            tar.add(path, path.relative_to(folder))
            path.unlink()


# ------------------------------------------------------------------------------------------ ours


class Ours:
    """Our search in one file layout."""

    def __init__(self, mapping: Path, query: Path, top_k: int) -> None:
        self.mapping, self.query, self.top_k = mapping, query, top_k
        self.images = KaptureFolder(mapping).read().image_names()
        self.queries = KaptureFolder(query).read().image_names()

    def search(self) -> None:
        """Search, from opening the vectors to the ranking."""
        self._search(self.images, self.queries)

    def tool(self, path: Path) -> None:
        """Run from kapture folders to the pairs file."""
        images = sorted(KaptureFolder(self.mapping).read().poses())
        queries = KaptureFolder(self.query).read().image_names()
        indices, scores = self._search(images, queries)
        ranked = zip(queries, indices.tolist(), scores.tolist(), strict=True)
        pairs = [
            ImagePair(query, images[k], score)
            for query, row, row_scores in ranked
            for k, score in zip(row, row_scores, strict=True)
        ]
        write_pairs(path, pairs)

    def _search(self, images: Sequence[str], queries: Sequence[str]) -> Any:
        map_vectors = KaptureVectors(KaptureFolder(self.mapping).global_features(TYPE), images)
        query_vectors = KaptureVectors(KaptureFolder(self.query).global_features(TYPE), queries)
        return rank_rows([query_vectors[:]], [map_vectors], self.top_k, FusionOptions())


def pairs_of(path: Path) -> Pairs:
    """Read the scores of a pairs file by query and map image."""
    pairs: Pairs = {}
    for pair in read_pairs(path):
        pairs.setdefault(pair.query, {})[pair.map] = pair.score
    return pairs


# ---------------------------------------------------------------------------- kapture-localization


class Theirs:
    """kapture-localization's compute_image_pairs, in this process."""

    def __init__(self, mapping: Path, query: Path, top_k: int) -> None:
        script = tool_scripts()["kapture_compute_image_pairs"]
        sys.path.append(str(script.parent))  # the script imports modules of its folder
        self._tool: Callable[..., None] = runpy.run_path(str(script))["compute_image_pairs"]
        self.mapping, self.query, self.top_k = str(mapping), str(query), top_k

    def search(self) -> None:
        """Run the steps of the tool without reading kapture tables and writing pairs."""
        import kapture
        from kapture.io.csv import get_all_tar_handlers, global_features_config_from_file
        from kapture.io.csv import global_features_from_dir as from_folder
        from kapture.io.features import global_features_to_filepaths

        pairing = importlib.import_module("kapture_localization.image_retrieval.pairing")
        stacked = []
        for folder in (self.mapping, self.query):
            with get_all_tar_handlers(folder) as handlers:
                features = from_folder(TYPE, folder, None, handlers)
                paths = global_features_to_filepaths(features, TYPE, folder, handlers)
                csv_path = kapture.io.csv.get_feature_csv_fullpath(
                    kapture.GlobalFeatures, TYPE, folder
                )
                config = global_features_config_from_file(csv_path)
                stacked.append(pairing.stack_global_features(config, sorted(paths.items())))
        similarity = pairing.get_similarity(stacked[1], stacked[0])
        pairing.get_image_pairs(similarity, self.top_k)

    def tool(self, path: Path) -> None:
        self._tool(self.mapping, self.query, str(path), TYPE, self.top_k)


# --------------------------------------------------------------------------------------- measuring


def timed(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def compared(ours: Pairs, theirs: Pairs) -> str:
    """Describe the difference of the pairs; pairs tied with the last score may differ."""
    same, largest, ties = 0, 0.0, 0
    for query in sorted(ours.keys() | theirs.keys()):
        a, b = ours.get(query, {}), theirs.get(query, {})
        last = min([*a.values(), *b.values()])
        for image in a.keys() | b.keys():
            if image in a and image in b:
                same += 1
                largest = max(largest, abs(a[image] - b[image]))
            elif abs({**a, **b}[image] - last) <= SCORE_TOLERANCE:
                ties += 1
            else:
                return f"PAIRS DIFFER: {query} with {image}"
    if largest > SCORE_TOLERANCE:
        return f"SCORES DIFFER by {largest:.1e}"
    return f"{same} pairs equal, {ties} of equal score differ, scores within {largest:.1e}"


def measure(options: argparse.Namespace) -> bool:
    names = [f"map/{k // 100:04d}/{k % 100:02d}.jpg" for k in range(options.images)]
    query_names = [f"query/{k:05d}.jpg" for k in range(options.queries)]
    vectors = random_vectors([0], len(names), options.dimension)
    queries = random_vectors([1], len(query_names), options.dimension)
    layouts = {"tar": True, "files": False}
    root = options.cache / f"retrieval_{options.images}_{options.queries}_{options.dimension}"
    methods: dict[str, Callable[[], Any]] = {"bare matrix product": lambda: queries @ vectors.T}
    pairs: dict[str, Callable[[], Pairs]] = {}
    folder = root / "pairs"
    folder.mkdir(parents=True, exist_ok=True)
    installed = True
    for layout, tar in layouts.items():
        mapping, query = root / layout / "map", root / layout / "query"
        generate(mapping, names, vectors, options.dimension, tar=tar)
        generate(query, query_names, queries, options.dimension, tar=tar)
        ours = Ours(mapping, query, options.top_k)
        file = folder / f"ours_{layout}.txt"
        methods[f"ours, {layout}, search"] = ours.search
        methods[f"ours, {layout}, whole tool"] = partial(ours.tool, file)
        pairs[f"ours, {layout}"] = partial(pairs_of, file)
        try:
            theirs = Theirs(mapping, query, options.top_k)
        except OptionError as error:
            print(error)
            installed = False
            continue
        file = folder / f"theirs_{layout}.txt"
        methods[f"kapture-localization, {layout}, search"] = theirs.search
        methods[f"kapture-localization, {layout}, whole tool"] = partial(theirs.tool, file)
        pairs[f"kapture-localization, {layout}"] = partial(pairs_of, file)
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for repetition in range(options.repetitions + 1):
        for name, method in methods.items():
            with contextlib.redirect_stderr(None):  # hides a progress bar
                spent = timed(method)
            if repetition:  # the first is a warm-up
                seconds[name].append(spent)
    product = float(np.median(seconds["bare matrix product"]))
    rows = [("", "median s", "min s", "of product")]
    for name, values in seconds.items():
        median = float(np.median(values))
        rows.append((name, f"{median:.3f}", f"{min(values):.3f}", f"{median / product:.2f}"))
    print(table(rows))

    def ratio(a: str, b: str) -> float:
        return float(np.median(seconds[a]) / np.median(seconds[b]))

    checks = [
        ("search of the tar / matrix product", "ours, tar, search", "bare matrix product", 2.5),
        ("search of files / search of the tar", "ours, files, search", "ours, tar, search", 2.0),
    ]
    if installed:
        for part in ("search", "whole tool"):
            name = f"tar, {part}"
            theirs_name = f"kapture-localization, {name}"
            checks.append(
                (f"{name}: ours / kapture-localization", f"ours, {name}", theirs_name, 0.5)
            )
    met = True
    for label, a, b, limit in checks:
        value = ratio(a, b)
        met &= value <= limit
        print(f"{label}: {value:.2f} (at most {limit:g}{'' if value <= limit else ': MISSED'})")
    reference = pairs["ours, tar"]()
    for name, read in pairs.items():
        difference = compared(reference, read())
        met &= "DIFFER" not in difference
        print(f"ours, tar, and {name}: {difference}")
    return met


# ------------------------------------------------------------------------------------ one million


class GeneratedVectors:
    """Random unit vectors, generated on reading; row ``k * spacing`` is near query k."""

    def __init__(self, length: int, queries: Vectors) -> None:
        self.shape, self._queries = (length, queries.shape[1]), queries
        self._spacing = length // len(queries)

    def __getitem__(self, part: slice) -> Vectors:
        start, stop, _ = part.indices(self.shape[0])
        rows = random_vectors([2, start], stop - start, self.shape[1])
        for k in range(-(-start // self._spacing), len(self._queries)):
            row = k * self._spacing
            if row >= stop:
                break
            rows[row - start] = 0.6 * self._queries[k] + 0.8 * rows[row - start]
        return rows


def million(options: argparse.Namespace) -> None:
    """Print the seconds, peak memory and number of planted rows ranked first."""
    queries = random_vectors([1], options.queries, options.dimension)
    database = GeneratedVectors(options.million_images, queries)
    start = time.perf_counter()
    indices, _ = rank_rows([queries], [database], options.top_k, FusionOptions())
    spent = time.perf_counter() - start
    planted = np.arange(len(queries)) * (database.shape[0] // len(queries))
    correct = int((indices[:, 0] == planted).sum())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20)
    print(json.dumps({"seconds": spent, "gib": memory, "correct": correct}))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--images", type=int, default=10_000)
    parser.add_argument("--queries", type=int, default=1_000)
    parser.add_argument("--dimension", type=int, default=4096)
    parser.add_argument("--top-k", type=int, default=50)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "megloc-bench")
    parser.add_argument("--million", action="store_true", help="also search generated vectors")
    parser.add_argument("--million-images", type=int, default=MILLION)
    parser.add_argument("--only-million", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only_million:
        million(options)
        return 0
    load = os.getloadavg()[0]
    print(
        f"{options.queries} queries in {options.images} images x {options.dimension}, "
        f"top {options.top_k}, {os.environ.get('OMP_NUM_THREADS', os.cpu_count())} threads, "
        f"load {load:.1f}"
    )
    met = measure(options)
    if options.million:
        command = [sys.executable, __file__, *sys.argv[1:], "--only-million"]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        result = json.loads(done.stdout)
        print(
            f"{options.million_images} vectors, generated and searched: "
            f"{result['seconds']:.0f} s, peak {result['gib']:.2f} GiB, "
            f"{result['correct']} of {options.queries} planted rows ranked first"
        )
        met &= result["gib"] < 6 and result["correct"] == options.queries
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
