"""``megloc train``: SuperGlue, or descriptors under a frozen detector."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from megloc_kapture.cli.common import Common, Force, Linked, Output
from megloc_kapture.cli.stages import Inputs
from megloc_kapture.errors import OptionError
from megloc_kapture.stages.work import Work


@dataclass(frozen=True, kw_only=True)
class Train(Linked, Common):
    """Train SuperGlue, or a detector's descriptors, on kapture folders with depth and on
    photographs. It goes on where it was interrupted."""

    task: Annotated[
        tyro.conf.Positional[Literal["matcher", "descriptor"]], tyro.conf.arg(metavar="TASK")
    ]
    """matcher: SuperGlue on frozen features; descriptor: of a frozen detector's keypoints."""
    input: Inputs = ()
    """Kapture folder with poses and depth; may be repeated."""
    photographs: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Folder of images, trained on under random homographies; may be repeated."""
    held_out: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Kapture folder with poses and depth to evaluate on; may be repeated."""
    licence: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Licence of a folder, for the manifest: FOLDER=TEXT; may be repeated."""
    output: Output
    """File to write: X.safetensors; beside it X.json, X.csv and X.state.pt."""
    features: str | None = None
    """Extractor whose features are matched, or whose detector is frozen; superpoint unless
    given."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """Change an option: key.key=value (steps=20000, pairs.max_size_px=800); may be repeated."""
    threads: int = 1
    """Threads that prepare pairs."""
    force: Force = False
    """Begin again where files of another training stand."""

    def run(self) -> int:
        """Run it."""
        # only this command waits for torch
        from megloc_kapture.pipeline.presets import options_with
        from megloc_kapture.training.train import TASKS, TrainingData, train

        console = self.console()
        changes = {} if self.features is None else {"features.name": self.features}
        options = options_with(TASKS[self.task], self.set, changes)
        licences = {}
        for text in self.licence:
            folder, equals, licence = text.rpartition("=")
            if not (folder and licence):
                raise OptionError(f"--licence takes FOLDER=TEXT, got {text!r}")
            licences[Path(folder)] = licence
        data = TrainingData(
            [self.kapture(path) for path in self.input],
            self.photographs,
            [self.kapture(path) for path in self.held_out],
            licences,
        )
        last = train(
            options,
            data,
            self.output,
            force=self.force,
            threads=self.threads,
            work=Work(track=console.track),
        )
        for name, value in last.items():
            if value == value:
                console.result(f"{name.replace('_', ' '):20s}{value:>12.6g}")
        console.result(f"trained: {self.output}")
        return 0
