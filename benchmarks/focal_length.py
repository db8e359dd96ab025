"""Effect of a wrong focal length on the pose, its confidence and the focal-length remark.

    .venv/bin/python benchmarks/focal_length.py --map NAME MAP QUERY TRUTH [--map ...] \\
        [--factors 1] [--seeds 0 1 2] [--every 2] [-o poses.csv]

MAP is a map to localize in, QUERY a kapture folder of queries with the correct focal length, TRUTH
a kapture folder with their poses. Each query is localized with its focal length multiplied by each
factor, and every pose is kept. Descriptors are matched once per query; geometric verification,
which depends on the camera, runs for each factor.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd

from megloc_kapture import KaptureMap, Localizer, Pose, Query
from megloc_kapture.geometry.cameras import focal_px, scale_focal
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline import live_source
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.query_folders import KaptureQueries
from megloc_kapture.stages.matches import match_all

FACTORS = (0.5, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.5)
MIN_INLIERS, FAR_M, CONFIDENT = 50, 0.25, 0.6
REMARK = re.compile(r"does not fit: (\d+) \+- (\d+) px")


def with_features(query: Query, localizer: Localizer) -> Query:
    """Extract the features of a query once for all focal lengths."""
    if query.features:
        return query
    (local,) = localizer.types
    image = query.read_image()
    features = {local.name: local.extractor.extract(image, query.read_mask())}
    return replace(query, image=image, features=features)


MATCHES: dict[tuple[str, ...], Any] = {}
"""Descriptor matches of the current query by the names of the map images."""


def cached_matches(matcher: Any, query: Any, others: Any, labels: Sequence[str]) -> Any:
    """Match descriptors once per query; the focal length has no effect on them."""
    if (key := tuple(labels)) not in MATCHES:
        MATCHES[key] = list(match_all(matcher, query, others, labels))
    return MATCHES[key]


def localized(
    paths: Sequence[str], factors: Sequence[float], seeds: Sequence[int], every: int
) -> Iterator[dict[str, Any]]:
    """Yield a row per query, factor and seed."""
    name, *folders = paths
    kapture_map = KaptureMap.open(Path(folders[0]))
    truth = KaptureFolder(Path(folders[2])).read()
    localizers = {
        seed: Localizer(
            kapture_map,
            options=options_of_preset(
                assignments={
                    "localization.min_confidence": 0.0,
                    "localization.sure_confidence": None,
                    "localization.pose.seed": seed,
                }
            ),
        )
        for seed in seeds
    }
    queries = KaptureQueries(KaptureFolder(Path(folders[1])), kapture_map)
    for image in queries.names[::every]:
        query = with_features(queries.query(image), localizers[seeds[0]])
        MATCHES.clear()
        pose = truth.cam_from_world(query.name)
        for seed, factor in ((seed, factor) for seed in seeds for factor in factors):
            scaled = replace(query, camera=scale_focal(query.camera, factor))
            result = localizers[seed].localize_query(scaled)
            row = {"map": name, "query": query.name, "factor": factor, "seed": seed}
            row |= {"inliers": result.num_inliers, "confidence": result.confidence or 0.0}
            row |= {"error_m": np.inf, "named_px": np.nan, "sigma_px": np.nan}
            row["right_px"] = focal_px(query.camera)
            if isinstance(result, Pose) and pose is not None:
                error = result.cam_from_world.center() - pose.center()
                row["error_m"] = float(np.linalg.norm(error))
            if named := REMARK.search("; ".join(result.remarks)):
                row |= {"named_px": float(named[1]), "sigma_px": float(named[2])}
            yield row


def summary(poses: pd.DataFrame) -> pd.DataFrame:
    """Count poses, remarks and errors per map and factor."""
    remark = poses.named_px.notna()
    far = (poses.error_m > FAR_M) & (poses.confidence >= CONFIDENT)
    enough = poses.inliers >= MIN_INLIERS
    # a standard deviation below a pixel is printed as 0
    right = (poses.named_px - poses.right_px).abs() <= 3 * poses.sigma_px.clip(lower=1)
    columns = {
        "poses": np.isfinite(poses.error_m),
        f"{MIN_INLIERS} inliers": enough,
        "of these remark": enough & remark,
        "right within 3 sigma": enough & remark & right,
        f"beyond {FAR_M} m": np.isfinite(poses.error_m) & (poses.error_m > FAR_M),
        f"of these confidence {CONFIDENT}, no remark": far & ~remark,
        f"of these confidence {CONFIDENT}, remark": far & remark,
    }
    keys = poses[["map", "factor"]]
    return pd.concat([keys, pd.DataFrame(columns)], axis=1).groupby(["map", "factor"]).sum()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = ("NAME", "MAP", "QUERY", "TRUTH")
    parser.add_argument("--map", nargs=4, metavar=names, action="append", required=True)
    parser.add_argument("--factors", nargs="+", type=float, default=FACTORS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--every", type=int, default=1, help="use every N-th query")
    parser.add_argument("-o", "--output", type=Path, help="CSV file with a row per pose")
    options = parser.parse_args()
    with patch.object(live_source, "match_all", cached_matches):
        rows = [
            row
            for paths in options.map
            for row in localized(paths, options.factors, options.seeds, options.every)
        ]
    poses = pd.DataFrame(rows)
    if options.output is not None:
        poses.to_csv(options.output, index=False)
    print(summary(poses).to_string())


if __name__ == "__main__":
    main()
