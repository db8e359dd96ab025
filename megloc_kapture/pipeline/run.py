"""A run of ``megloc eval``: its dataset, preset, options and workspace."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from megloc_kapture.io.side_tables import SIDE_TABLES, read_protocol
from megloc_kapture.pipeline.benchmarks import BenchmarkFile
from megloc_kapture.pipeline.datasets import TWIN_PREFIX, DatasetChoice
from megloc_kapture.pipeline.paper_steps import PaperStep
from megloc_kapture.pipeline.submission import place_of
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.layout import SUBMISSIONS
from megloc_kapture.stages.options import PipelineOptions


@dataclass(frozen=True)
class Run:
    """What a run is of.

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
    steps: tuple[PaperStep, ...] = ()

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

    def provenance(self) -> dict[str, Any]:
        """What a result is of, as plain JSON values."""
        options = self.options.model_dump(mode="json")
        return {"dataset": self.dataset, "preset": self.preset, "options": options}
