"""kapture-localization's tools, step by step, on existing features and pairs.

The steps are those of its pipelines kapture_pipeline_mapping and kapture_pipeline_localize, but
with its pycolmap localizer instead of COLMAP's image_registrator (equally fast and accurate here,
and two steps shorter). The creation of folders of links is not timed.
"""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from timing import Timed, timed_command

# its default configuration 1: fixed camera parameters
FIXED_CAMERAS = (
    *("--Mapper.ba_refine_focal_length", "0"),
    *("--Mapper.ba_refine_principal_point", "0"),
    *("--Mapper.ba_refine_extra_params", "0"),
)


@dataclass(frozen=True)
class Inputs:
    """Inputs of both sides: images, features of one type and pairs."""

    mapping: Path
    query: Path
    features: Path  # folder with keypoints/ and descriptors/
    features_type: str
    mapping_pairs: Path
    query_pairs: Path

    @classmethod
    def of_workspace(cls, workspace: Path, features_type: str) -> Inputs:
        return cls(
            workspace / "mapping",
            workspace / "query",
            workspace / "local_features" / features_type,
            features_type,
            workspace / "pairs" / "mapping.txt",
            workspace / "pairs" / "query.txt",
        )


class KaptureLocalization:
    """The tools of an environment; each call is a timed step with a log in ``folder``."""

    def __init__(self, python: Path, folder: Path, threads: int) -> None:
        # a resolved link would be the Python outside the environment
        self.python = Path(os.path.abspath(python))
        self.folder = folder
        self.environment = {
            **os.environ,
            "PATH": f"{self.python.parent}{os.pathsep}{os.environ['PATH']}",
            "QT_QPA_PLATFORM": "offscreen",  # otherwise COLMAP 3 opens a display
            "OMP_NUM_THREADS": str(threads),
        }
        self.environment.pop("PYTHONPATH", None)
        self.steps: list[Timed] = []

    def run(self, step: str, tool: str, arguments: Sequence[object]) -> None:
        command = [str(self.python), str(self.python.parent / f"{tool}.py"), *map(str, arguments)]
        log = self.folder / f"{step.replace(' ', '_')}.log"
        self.steps.append(timed_command(step, command, self.environment, log))

    def versions(self) -> str:
        """Return the versions of the packages that determine the speed, on one line."""
        code = (
            "import importlib.metadata as m;"
            "print(*(f'{n} {m.version(n)}' for n in "
            "('kapture-localization', 'kapture', 'pycolmap', 'torch', 'numpy')), sep=', ')"
        )
        done = subprocess.run(
            [str(self.python), "-c", code], capture_output=True, text=True, check=True
        )
        usage = subprocess.run(
            ["colmap", "-h"], capture_output=True, text=True, env=self.environment, check=False
        )
        colmap = re.search(r"^COLMAP \S+", usage.stdout, re.MULTILINE)
        return f"{done.stdout.strip()}, {colmap.group() if colmap else 'COLMAP of unknown version'}"


def localize(tools: KaptureLocalization, inputs: Inputs) -> Path:
    """Map and localize; return the kapture folder with the query poses."""
    out = tools.folder
    colmap_map, kapture_map, merged = out / "colmap_map", out / "kapture_map", out / "merged"
    localized = out / "localized"

    raw = _proxy(out / "raw_map", inputs.mapping, inputs)
    verified = _proxy(out / "verified_map", inputs.mapping, inputs)
    pairs = ["--pairsfile-path", inputs.mapping_pairs]
    tools.run("match mapping", "kapture_compute_matches", ["-i", raw, *pairs])
    tools.run("verify mapping", "kapture_run_colmap_gv", ["-f", "-i", raw, "-o", verified, *pairs])
    pairs = ["--pairs-file-path", inputs.mapping_pairs]
    tools.run(
        "triangulate",
        "kapture_colmap_build_map",
        ["-f", "-i", verified, "-o", colmap_map, *pairs, *FIXED_CAMERAS],
    )
    model = ["-txt", colmap_map / "reconstruction", "-kpt", inputs.features_type]
    tools.run("import map", "kapture_import_colmap", ["-f", *model, "-o", kapture_map])

    skipped = ["-s", "keypoints", "descriptors", "global_features", "matches"]
    both = ["-i", inputs.mapping, inputs.query, "--image_transfer", "link_absolute"]
    tools.run("merge", "kapture_merge", ["-f", *both, "-o", merged, *skipped])
    raw = _proxy(out / "raw", merged, inputs)
    verified = _proxy(out / "verified", merged, inputs)
    pairs = ["--pairsfile-path", inputs.query_pairs]
    tools.run("match query", "kapture_compute_matches", ["-i", raw, *pairs])
    tools.run("verify query", "kapture_run_colmap_gv", ["-f", "-i", raw, "-o", verified, *pairs])
    for name in ("points3d.txt", "observations.txt"):
        (verified / "reconstruction" / name).symlink_to(kapture_map / "reconstruction" / name)
    tools.run(
        "localize",
        "kapture_pycolmap_localize",
        ["-f", "-i", verified, "--query", inputs.query, "-o", localized, *pairs],
    )
    return localized


@dataclass(frozen=True)
class Score:
    """Result of kapture_evaluate; queries without a pose count as failures."""

    recalls: dict[str, float]  # bin -> percent
    median_m: float
    median_deg: float


def evaluate(
    tools: KaptureLocalization,
    results: dict[str, Path],
    truth: Path,
    thresholds: Sequence[tuple[float, float]],
) -> dict[str, Score]:
    """Evaluate the poses of both sides with kapture-localization; not a timed step."""
    out = tools.folder / "evaluation"
    bins = [f"{metres} {degrees}" for metres, degrees in thresholds]
    results_and_labels = ["-i", *results.values(), "--labels", *results]
    tools.run(
        "evaluate",
        "kapture_evaluate",
        ["-f", *results_and_labels, "-gt", truth, "-o", out, "--bins", *bins],
    )
    tools.steps.pop()
    scores: dict[str, Score] = {}
    models = re.split(r"^Model: (.*)$", (out / "stats.txt").read_text(), flags=re.MULTILINE)
    for label, text in zip(models[1::2], models[2::2], strict=True):
        recalls = re.findall(r"^\((\S+)m, (\S+) deg\): (\S+)%$", text, re.MULTILINE)
        median = re.search(r"^All: median=\((\S+)m, (\S+) deg\)$", text, re.MULTILINE)
        scores[label] = Score(
            {f"{metres} m, {degrees} deg": float(percent) for metres, degrees, percent in recalls},
            float(median.group(1)) if median else float("nan"),
            float(median.group(2)) if median else float("nan"),
        )
    return scores


def _proxy(folder: Path, sensors: Path, inputs: Inputs) -> Path:
    """Create a kapture folder with links to sensors and features and an empty matches folder."""
    reconstruction = folder / "reconstruction"
    for kind in ("keypoints", "descriptors"):
        (reconstruction / kind).mkdir(parents=True)
        (reconstruction / kind / inputs.features_type).symlink_to(
            (inputs.features / kind).resolve()
        )
    (reconstruction / "matches" / inputs.features_type).mkdir(parents=True)
    (folder / "sensors").symlink_to((sensors / "sensors").resolve())
    return folder
