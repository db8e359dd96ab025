"""What a run of ``megloc eval`` works on and with, and where in its workspace things stand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.kapture_folders import MAPPING, QUERY, QUERY_GT
from megloc_kapture.datasets.official import REFERENCE
from megloc_kapture.io.side_tables import SIDE_TABLES, read_protocol
from megloc_kapture.pipeline.benchmarks import BenchmarkFile
from megloc_kapture.pipeline.datasets import TWIN_PREFIX, DatasetChoice
from megloc_kapture.pipeline.options import PipelineOptions
from megloc_kapture.pipeline.paper_steps import PaperStep
from megloc_kapture.pipeline.submission import place_of
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.restrictions import Restrictions
from megloc_kapture.stages.work import HERE, Work

__all__ = [
    "EVALUATION",
    "LOCALIZED",
    "MAP",
    "MAPPING",
    "MAPPING_MATCHES",
    "MAPPING_PAIRS",
    "MAPPING_PYRAMID",
    "PREPROCESSED",
    "QUERY",
    "QUERY_CANDIDATES",
    "QUERY_GT",
    "QUERY_MATCHES",
    "QUERY_PAIRS",
    "QUERY_PYRAMID",
    "REFERENCE",
    "REFINEMENT_TIMING",
    "SUBMISSIONS",
    "TIMING",
    "UNREFINED",
    "UNREFINED_POSES",
    "Run",
]

MAPPING_PAIRS, QUERY_PAIRS = "pairs/mapping.txt", "pairs/query.txt"
QUERY_CANDIDATES = "pairs/query_candidates.txt"  # before they are reranked
MAPPING_MATCHES, QUERY_MATCHES = "matches/mapping", "matches/query"
UNREFINED, MAP = "map_unrefined", "map"
MAPPING_PYRAMID, QUERY_PYRAMID = "pyramid/mapping", "pyramid/query"
PREPROCESSED = "preprocessed"
UNREFINED_POSES, REFINEMENT_TIMING = "localized_unrefined", "timing_refinement.csv"
LOCALIZED, SUBMISSIONS, EVALUATION = "localized", "submissions", "evaluation"
TIMING = "timing.csv"


@dataclass(frozen=True)
class Run:
    """What a run works on and with.

    Attributes
    ----------
    benchmark : what it wants different in the dataset's protocol.
    steps : of the paper, for the report.
    """

    source: DatasetChoice
    preset: str
    options: PipelineOptions
    workspace: Workspace
    benchmark: BenchmarkFile | None = None
    work: Work = HERE
    steps: tuple[PaperStep, ...] = ()

    @property
    def images_stage(self) -> str:
        """Name of the stage that writes :attr:`mapping` and :attr:`query`."""
        return "preprocess" if self.options.preprocesses() else "import"

    @property
    def mapping(self) -> str:
        """The kapture folder of the map's images, as everything after pre-processing sees them."""
        return f"{PREPROCESSED}/{MAPPING}" if self.options.preprocesses() else MAPPING

    @property
    def query(self) -> str:
        """The kapture folder of the queries' images; see :attr:`mapping`."""
        return f"{PREPROCESSED}/{QUERY}" if self.options.preprocesses() else QUERY

    def mapping_features(self) -> list[str]:
        """Features folders of the map's images, once they are matched."""
        places = ["", MAPPING_MATCHES]
        if self.options.matches_again() and self.options.triangulates():
            places.append(MAPPING_PYRAMID)
        return places

    def query_features(self) -> list[str]:
        """Features folders of the queries, once they are matched."""
        places = ["", QUERY_MATCHES]
        if self.options.matches_again():
            places.append(QUERY_PYRAMID)
        return places

    @property
    def first_poses(self) -> str:
        """The localized queries as localization leaves them, before poses are refined."""
        return UNREFINED_POSES if self.options.pose_refinement.refines() else LOCALIZED

    @property
    def dataset(self) -> str:
        """The dataset's name."""
        return self.source.name

    def submission_below(self, folder: Path) -> Path:
        """Where, below ``folder``, the pose file stands; a folder where it is several files.

        Its name is the server's, ``Aachen_v1_1_eval_METHOD.txt``. That of a rendered twin begins
        with ``synthetic-``: there is no server for it.
        """
        protocol = read_protocol(self.workspace.path(SIDE_TABLES))
        stem = self.dataset
        if protocol.pose_file_stem and not stem.startswith(TWIN_PREFIX):
            stem = protocol.pose_file_stem
        return place_of(folder / SUBMISSIONS, f"{stem}_eval_megloc-{self.preset}", protocol)

    def restrictions(self) -> Restrictions:
        """What the dataset's side tables permit."""
        return Restrictions.read(self.workspace.path(SIDE_TABLES))
