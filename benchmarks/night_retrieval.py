"""Retrieval on Aachen's twin: recall of the right map images for its night queries.

    MEGLOC_WEIGHTS=weights .venv/bin/python benchmarks/night_retrieval.py --workspace DIR

Each feature alone, all fused early and late, and the fused ones reranked by local matches. An image
is right where it sees at least 30 % of the surface that the query sees, by the exact geometry of
the rendered world (retrieval_truth.py). Two figures for each N: queries with a right image among
their first N, and the share of right images that is there of those that could be.

The twin's map is of daylight only. The second table asks whether a feature prefers images of the
query's own light: there the other night queries count as map images too. Had light no part in it,
the share of night images among the first ten would be that among the right images.

Features whose weights are absent, or h5py, which one file needs, are named and left out.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from retrieval_networks import espnetv2, squeezenet
from retrieval_truth import MIN_OVERLAP, recalls, twin_overlaps

from megloc_kapture.errors import DataError
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, MatchesReader
from megloc_kapture.matching.verification import TwoViewOptions
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.retrieval.fusion import FusionOptions, fuse
from megloc_kapture.stages.global_features import extract_vlad, vlad_type
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.work import Work

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

# plugins, and the types their features are stored under
LOCAL_TYPES = {"rootsift": "rootsift", "aliked": "aliked-n16", "xfeat": "xfeat"}
NETWORKS = {"squeezenet gem": squeezenet, "espnetv2 gem": espnetv2}
COUNTS = (1, 5, 10, 20)
RERANKED = 50
NIGHT = "query/night/"

Vectors = Mapping[str, NDArray[np.float32]]


def prepare(workspace: Path, workers: int) -> None:
    """Render the twin and extract its local features; what is there is kept."""
    program = str(Path(sys.executable).with_name("megloc"))
    types = ", ".join(f'"{name}"' for name in LOCAL_TYPES)
    command = [program, "eval", "synthetic-aachen", "-w", str(workspace), "-q"]
    command += ["--workers", str(workers), "--set", f"local_features=[{types}]"]
    done = subprocess.run([*command, "--until", "local_features"], check=False)
    if done.returncode != 0:
        sys.exit(f"failed with {done.returncode}: {' '.join(command)}")


def opened(workspace: Path, *features: Path) -> tuple[KaptureFolder, KaptureFolder]:
    """Map and queries."""
    places = [workspace, *features]
    return (
        KaptureFolder(workspace / "mapping", features_dirs=places),
        KaptureFolder(workspace / "query", features_dirs=places),
    )


def describe(
    workspace: Path, output: Path, workers: int
) -> tuple[list[str], list[str], dict[str, NDArray[np.float32]]]:
    """Map images, queries, and for each feature the vectors of both, in this order."""
    mapping, query = opened(workspace)
    images, queries = mapping.read().image_names(), query.read().image_names()
    options = VladOptions()
    with open_executor("processes", workers) as executor:
        for local_type in LOCAL_TYPES.values():
            extract_vlad(
                mapping, [mapping, query], local_type, output, options, work=Work(executor)
            )
    mapping, query = opened(workspace, output)
    found: dict[str, NDArray[np.float32]] = {}
    for name, local_type in LOCAL_TYPES.items():
        readers = (mapping, images), (query, queries)
        found[f"vlad {name}"] = np.stack(
            [
                folder.global_features(vlad_type(local_type)).read(image).reshape(-1)
                for folder, some in readers
                for image in some
            ]
        )
    paths = [mapping.image_path(image) for image in images]
    paths += [query.image_path(image) for image in queries]
    for name, network in NETWORKS.items():
        try:
            vector_of = network()
        except (DataError, ImportError) as error:
            print(f"left out: {name}: {error}")
            continue
        found[name] = np.stack([vector_of(read_image_rgb(path)) for path in paths])
    return images, queries, found


def fused(vectors: Vectors) -> dict[str, NDArray[np.floating]]:
    """Similarities (N, N) of each feature, and of the fused ones."""
    found = {name: rows @ rows.T for name, rows in vectors.items()}
    vlads = [name for name in found if name.startswith("vlad")]
    for label, names in (("vlads", vlads), ("all", list(vectors))):
        for method in ("ghm", "mean"):
            options = FusionOptions.model_validate({"method": method})
            found[f"{label}, late ({method})"] = fuse([found[name] for name in names], options)
    return found


def match_counts(
    workspace: Path, output: Path, candidates: Mapping[str, Sequence[str]], name: str, workers: int
) -> dict[tuple[str, str], int]:
    """Verified matches of each query with its candidates."""
    mapping, query = opened(workspace)
    pairs = [ImagePair(q, image, 1.0) for q, images in candidates.items() for image in images]
    local_type = LOCAL_TYPES[name]
    options = options_of_preset(assignments=[f"local_features={name}"])
    matcher = options.make_matcher(local_type)
    with open_executor("processes", workers) as executor:
        match_pairs(
            query,
            mapping,
            pairs,
            local_type,
            matcher,
            TwoViewOptions(),
            output,
            work=Work(executor),
        )
    reader = KaptureFolder(workspace / "query", features_dirs=[output]).matches(local_type)
    return {(pair.query, pair.map): matches_of(reader, pair) for pair in pairs}


def matches_of(reader: MatchesReader, pair: ImagePair) -> int:
    """How many matches of a pair were verified."""
    return len(reader.read(pair.query, pair.map)[0])


def recall_row(
    name: str, similarities: NDArray[np.floating], right: NDArray[np.bool_]
) -> tuple[str, ...]:
    """A row of the first table."""
    found = recalls(similarities, right, COUNTS)
    return (name, *(f"{some:.0f} / {share:.0f}" for some, share in found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workspace", type=Path, required=True, help="kept for the next time")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    arguments = parser.parse_args()
    root: Path = arguments.workspace.resolve()
    twin = root / "twin"
    prepare(twin, arguments.workers)
    with single_threaded():
        images, queries, vectors = describe(twin, root / "global", arguments.workers)
        report(root, images, queries, vectors, arguments.workers)


def report(
    root: Path,
    images: Sequence[str],
    queries: Sequence[str],
    vectors: Vectors,
    workers: int,
) -> None:
    """Print both tables."""
    night = [query for query in queries if query.startswith(NIGHT)]
    columns = np.arange(len(images))
    rows_of = {
        "night": np.array([len(images) + queries.index(query) for query in night]),
        "day": np.array(
            [len(images) + row for row, query in enumerate(queries) if query not in night]
        ),
    }
    names = [*images, *queries]
    overlaps = twin_overlaps(list(night), names)
    right = {"night": overlaps[:, columns] >= MIN_OVERLAP}
    by_day = [names[row] for row in rows_of["day"]]
    right["day"] = twin_overlaps(by_day, list(images)) >= MIN_OVERLAP
    similarities = fused(vectors)

    late = similarities["all, late (ghm)"][np.ix_(rows_of["night"], columns)]
    best = np.argsort(-late, axis=1, kind="stable")[:, :RERANKED]
    candidates = {query: [images[i] for i in row] for query, row in zip(night, best, strict=True)}
    for light in ("night", "day"):
        print(
            f"\n{len(right[light])} queries by {light}, {len(images)} map images by day; ", end=""
        )
        print("queries with a right image / right images found, %")
        table_rows = [("feature", *(f"@{count}" for count in COUNTS))]
        for name, matrix in similarities.items():
            some = matrix[np.ix_(rows_of[light], columns)]
            table_rows.append(recall_row(name, some, right[light]))
        if light == "night":
            for local in LOCAL_TYPES:
                counts = match_counts(root / "twin", root / local, candidates, local, workers)
                # what is not among the candidates comes behind them, in its order
                reranked = late - 10.0
                for query, row in enumerate(best):
                    for place, image in enumerate(row):
                        score = counts[night[query], images[image]]
                        reranked[query, image] = score - place / RERANKED / 2
                label = f"all, late (ghm), {RERANKED} reranked by {local}"
                table_rows.append(recall_row(label, reranked, right[light]))
        print(table(table_rows))

    # the other night queries as map images
    pool = np.concatenate([columns, rows_of["night"]])
    of_night = np.arange(len(pool)) >= len(columns)
    shared = overlaps[:, pool] >= MIN_OVERLAP
    own = rows_of["night"][:, None] == pool
    shared &= ~own
    expected = 100 * np.mean([of_night[row].mean() for row in shared if row.any()])
    print(
        f"\nwith the other night queries in the map: of the right images {expected:.0f} % are of ",
        end="",
    )
    print("night; of the first ten, %")
    table_rows = [("feature", "night", "right", "right, by day")]
    for name, matrix in similarities.items():
        some = np.where(own, -np.inf, matrix[np.ix_(rows_of["night"], pool)])
        first = np.argsort(-some, axis=1, kind="stable")[:, :10]
        hit = np.take_along_axis(shared, first, axis=1)
        dark = of_night[first]
        table_rows.append(
            (name, *(f"{100 * float(x.mean()):.0f}" for x in (dark, hit, hit & ~dark)))
        )
    print(table(table_rows))


if __name__ == "__main__":
    main()
