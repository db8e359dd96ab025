"""``megloc import`` and ``megloc synth``: datasets as kapture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from megloc_kapture.cli.common import Common, Force, Output, Working
from megloc_kapture.datasets.kapture_folders import import_kapture_folders
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.errors import OptionError
from megloc_kapture.io.outputs import staged_output
from megloc_kapture.pipeline.executors import open_executor

DATASET = "dataset"


@dataclass(frozen=True, kw_only=True)
class Import(Common):
    """Bring a dataset into DIR/{mapping,query,query_gt,megloc}; images are linked, not copied."""

    dataset: tyro.conf.Positional[str]
    """kapture: any pair of kapture folders."""
    root: tyro.conf.Positional[Path]
    """Folder of the dataset."""
    output: Output
    """Where to."""
    query_prefix: str = ""
    """Put the queries into a folder of this name, where they share names with the map."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        if self.dataset != "kapture":
            raise OptionError(f"unknown dataset {self.dataset!r}; known: kapture")
        with staged_output(self.output, kind=DATASET, force=self.force) as out:
            counts = import_kapture_folders(self.root, out, query_prefix=self.query_prefix)
        for name, value in counts.items():
            console.result(f"{name.replace('_', ' '):24s}{value:g}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Synth(Working, Common):
    """Render the synthetic world: DIR/{mapping,query,query_gt,megloc} in kapture, with truth."""

    dataset: tyro.conf.Positional[str] = "synthetic"
    """synthetic: the world as plain kapture."""
    output: Output
    """Where to."""
    seed: int = 0
    """Another seed is another world."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        from megloc_kapture.datasets.synthetic.writing import write_synthetic_kapture

        console = self.console()
        if self.dataset != "synthetic":
            raise OptionError(f"unknown dataset {self.dataset!r}; known: synthetic")
        options = SyntheticWorldOptions(seed=self.seed)
        with (
            staged_output(self.output, kind=DATASET, force=self.force) as out,
            open_executor(self.executor, self.workers) as executor,
        ):
            write_synthetic_kapture(out, options, executor=executor, track=console.track)
        console.result(f"rendered: {self.output}")
        return 0
