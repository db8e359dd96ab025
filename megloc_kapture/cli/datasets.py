"""``megloc import`` and ``megloc synth``: datasets as kapture, and rendered ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from megloc_kapture.cli.common import Common, Force, Output, Working
from megloc_kapture.datasets.kapture_folders import QUERY
from megloc_kapture.io.dataset_tables import SIDE_TABLES
from megloc_kapture.io.files import staged_output
from megloc_kapture.pipeline.datasets import (
    KAPTURE,
    SUMMARY_FILE,
    SYNTHETIC,
    TWIN_PREFIX,
    choose_dataset,
    twin_of,
)
from megloc_kapture.pipeline.executors import open_executor
from megloc_kapture.pipeline.presets import assigned
from megloc_kapture.stages.unreadable import set_aside_unreadable
from megloc_kapture.stages.work import Work

DATASET = "dataset"


@dataclass(frozen=True, kw_only=True)
class Import(Common):
    """Bring a dataset into DIR/{mapping,query,query_gt,megloc}; images are linked, not copied."""

    dataset: tyro.conf.Positional[str]
    """aachen, robotcar, 4seasons, inloc, or kapture: any pair of kapture folders."""
    root: tyro.conf.Positional[Path]
    """Folder of the dataset, laid out as it is published."""
    output: Output
    """Where to."""
    allow_missing: bool = False
    """Import what is there of a partial download."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """An option of the dataset: key=value (version=1.0, reference_model=true); may be repeated."""
    query_prefix: str = ""
    """Put the queries into a folder of this name, where they share names with the map."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        name = self.dataset.removeprefix(TWIN_PREFIX)
        choice = choose_dataset(
            KAPTURE if name == SYNTHETIC else name,
            self.root,
            import_options=assigned(self.set),
            query_prefix=self.query_prefix,
            allow_missing=self.allow_missing,
        )
        choice.check()
        with staged_output(self.output, kind=DATASET, force=self.force) as out:
            counts = choice.import_to(self.root, out)
            work = Work(track=console.track)
            unreadable = set_aside_unreadable(out / QUERY, out / SIDE_TABLES, work)
            summary = out / SUMMARY_FILE
            text = summary.read_text(encoding="utf-8") if summary.is_file() else ""
        for what, value in counts.items():
            console.result(f"{what.replace('_', ' '):44s}{value:>8g}")
        for name, reason in unreadable.items():
            console.say(f"warning: query {name} cannot be used and will fail: {reason}")
        if text:
            console.result(text.rstrip())
        return 0


@dataclass(frozen=True, kw_only=True)
class Synth(Working, Common):
    """Render a dataset: the synthetic world as kapture, or a small twin in an official layout."""

    dataset: tyro.conf.Positional[str] = SYNTHETIC
    """synthetic: the world as plain kapture; aachen, robotcar, 4seasons, inloc: its twin."""
    output: Output
    """Where to."""
    seed: int = 0
    """Another seed is another world."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """An option of the world: key=value; may be repeated."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        changes = {"seed": self.seed, **assigned(self.set)}
        twin = twin_of(self.dataset.removeprefix(TWIN_PREFIX), **changes)
        with (
            staged_output(self.output, kind=DATASET, force=self.force) as out,
            open_executor(self.executor, self.workers) as executor,
        ):
            counts = twin.write(out, Work(executor, console.track))
        for what, value in counts.items():
            console.result(f"{what.replace('_', ' '):44s}{value:>8g}")
        console.result(f"rendered: {self.output}")
        return 0
