"""Images of 800 and 1024 px: localized as they are, and enlarged to the paper's 1600 px.

    .venv/bin/python benchmarks/enlarging.py --scene DIR --scene DIR -o enlarging.csv

A scene is a folder with mapping/, query/ and query_gt/ in kapture; its images are made smaller
first. Features are learned ones with a matcher that learned context, as SuperPoint and SuperGlue
are, and as many keypoints as the paper takes. Arguments that are not known here go to
``megloc eval``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from scenes import errors_of, hits, megloc

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

SIZES_PX = (800, 1024)
ENLARGED_PX = 1600  # MegLoc's larger side
_KEYPOINTS = "local_features.options.max_keypoints=1500"
FEATURES: dict[str, tuple[str, ...]] = {
    "ALIKED, LightGlue": (
        "local_features=aliked",
        _KEYPOINTS,
        "local_features.options.threshold=0.05",
        "matching.name=lightglue",
        "matching.options.weights=aliked_lightglue",
    ),
    "XFeat, LighterGlue": (
        "local_features=xfeat",
        _KEYPOINTS,
        "matching.name=lighterglue",
    ),
}


def shrink(scene: Path, size_px: int, root: Path) -> Path:
    """Write the scene with images of a larger side, unless it is there."""
    if not (root / "query_gt").is_dir():
        for part in ("mapping", "query"):
            made = ("-o", str(root / part), "-f", "--resize", str(size_px))
            megloc("preprocess", "-i", str(scene / part), *made)
        shutil.copytree(scene / "query_gt", root / "query_gt")
    return root


def measure(
    scene: Path, features: str, enlarge: bool, workspace: Path, arguments: Sequence[str]
) -> dict[str, float]:
    """Recall in percent, medians, and what the map got."""
    sets = [*FEATURES[features], f"preprocessing.upscale={str(enlarge).lower()}"]
    sets += [f"preprocessing.max_size_px={ENLARGED_PX}"]
    given = [part for text in sets for part in ("--set", text)]
    places = ("--root", str(scene), "--workspace", str(workspace))
    megloc("eval", "kapture", *places, *given, *arguments)
    errors = errors_of(workspace / "evaluation")
    stages = {
        name: json.loads((workspace / "stages" / f"{name}.json").read_text())
        for name in ("local_features", "mapping_matches", "points", "query_matches")
    }
    found = stages["local_features"]["counts"]
    return {
        **hits(errors).mean().to_dict(),
        "median mm": 1e3 * errors.error_m.median(),
        "median deg": errors.error_deg.median(),
        "keypoints": found["keypoints"] / found["images"],
        "points": stages["points"]["counts"]["points"],
        "seconds": sum(stage["seconds"] for stage in stages.values()),
    }


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=lambda text: Path(text).resolve(), action="append")
    parser.add_argument("--features", action="append", choices=FEATURES)
    parser.add_argument("--size", type=int, action="append")
    parser.add_argument("--workspace", type=Path, help="keep scenes and runs here")
    parser.add_argument("-o", "--output", type=Path, help="write the rows here as CSV")
    options, arguments = parser.parse_known_args()
    rows: list[dict[str, float | str]] = []
    with tempfile.TemporaryDirectory(prefix="megloc-enlarging-") as temporary:
        root = options.workspace or Path(temporary)
        for scene in options.scene or ():
            for size_px in options.size or SIZES_PX:
                small = shrink(scene, size_px, root / f"{scene.name}-{size_px}")
                for features in options.features or FEATURES:
                    for enlarge in (False, True):
                        name = f"{small.name}-{features.replace(', ', '-')}-{enlarge}"
                        row = measure(small, features, enlarge, root / name, arguments)
                        told = {"scene": scene.name, "size px": size_px, "features": features}
                        rows.append({**told, "enlarged": "yes" if enlarge else "no", **row})
                        print(rows[-1], file=sys.stderr, flush=True)
                        if options.output is not None:
                            pd.DataFrame(rows).to_csv(options.output, index=False)
    cells = [
        [f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()]
        for row in rows
    ]
    print(table([list(rows[0]), *cells] if rows else []))


if __name__ == "__main__":
    main()
