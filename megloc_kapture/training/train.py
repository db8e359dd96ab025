"""Training from folders to files: networks, curves, and a manifest of the options."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import read_content, remove, write_bytes, write_json
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.nets.runtime import state_bytes
from megloc_kapture.nets.superglue import SuperGlueNet
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.training.pairs import PairSource, Photographs, PosedPairs
from megloc_kapture.training.trainer import (
    COLUMNS,
    DescriptorOptions,
    Trainer,
    TrainingOptions,
    TrainingState,
)

TASKS: dict[str, type[TrainingOptions]] = {
    "matcher": TrainingOptions,
    "descriptor": DescriptorOptions,
}


@dataclass(frozen=True)
class TrainingData:
    kaptures: Sequence[KaptureFolder] = ()  # with poses and depth
    photographs: Sequence[Path] = ()  # folders of images, trained on under homographies
    # kaptures that are only evaluated on; no folder of ``kaptures`` may be one
    held_out: Sequence[KaptureFolder] = ()

    def check(self) -> None:
        trained = [folder.root for folder in self.kaptures]
        if not (trained or self.photographs):
            raise OptionError("nothing to train on: give a kapture with depth, or photographs")
        both = {path.resolve() for path in trained} & {f.root.resolve() for f in self.held_out}
        if both:
            raise OptionError(f"{min(both)}: is trained on and held out")
        if len({folder.root.name for folder in self.held_out}) < len(self.held_out):
            raise OptionError("held-out folders need different names")


def train(
    options: TrainingOptions,
    data: TrainingData,
    output: Path,
    *,
    force: bool = False,
    threads: int = 1,
    work: Work = HERE,
) -> dict[str, float]:
    """Train a matcher, or descriptors with :class:`DescriptorOptions`, to the last step.

    Each evaluation writes ``output`` (``X.safetensors``), for descriptors trained through SuperGlue
    also ``X-superglue.safetensors``, the manifest ``X.json``, the curves ``X.csv`` and
    ``X.state.pt``, from which the same call resumes; ``X.overlaps`` is written before. ``force``
    replaces another training's files; ``threads`` prepare pairs. Returns the last row of the
    curves.
    """
    if output.suffix != ".safetensors":
        raise OptionError(f"{output}: the file to write must end in .safetensors")
    data.check()
    files, trainer = _Files(output), Trainer(options)
    files.begin(force=force)
    posed = [
        PosedPairs(folder, options.pairs, work, files.overlaps / f"{number:03d}.txt")
        for number, folder in enumerate([*data.kaptures, *data.held_out])
    ]
    sources: list[PairSource] = [*posed[: len(data.kaptures)]]
    sources += [Photographs(folder, options.pairs) for folder in data.photographs]
    held_out = {source.folder.name: source for source in posed[len(data.kaptures) :]}
    record = {
        "task": next(name for name, kind in TASKS.items() if kind is type(options)),
        "options": json.loads(options.model_dump_json()),
        "weights": getattr(trainer.extractor, "weights", dict)(),
        "data": {source.folder.name: source.counts() for source in sources},
        "held_out_data": {name: source.counts() for name, source in held_out.items()},
    }
    files.claim(record, force=force)
    state = TrainingState.resume(files.state, trainer.model, trainer.optimizer)
    if state.step < options.steps:
        trainer.hold_out(held_out)
    for reached in trainer.train(sources, state, work, threads=threads):
        state = reached
        files.write(trainer, state, record)
    return dict(zip(COLUMNS, state.rows[-1], strict=True)) if state.rows else {}


class _Files:
    def __init__(self, output: Path) -> None:
        self.output = output
        self.state, self.manifest = output.with_suffix(".state.pt"), output.with_suffix(".json")
        self.overlaps = output.with_suffix(".overlaps")

    def begin(self, *, force: bool) -> None:
        if force or not (self.output.exists() or self.manifest.exists()):
            remove(self.state)
            remove(self.overlaps)

    def claim(self, record: Mapping[str, Any], *, force: bool) -> None:
        if force or not (self.output.exists() or self.manifest.exists()):
            return
        try:
            known = json.loads(read_content(self.manifest)).get("training")
        except (DataError, ValueError, AttributeError):
            known = None
        if known is None:
            raise OutputError(f"{self.output}: is of no training; -f replaces it")
        if known != record:
            changed = sorted(k for k in {*known, *record} if known.get(k) != record.get(k))
            raise OutputError(
                f"{self.manifest}: is of another training ({', '.join(changed)}); -f begins again"
            )

    def write(self, trainer: Trainer, state: TrainingState, record: Mapping[str, Any]) -> None:
        model = trainer.model
        networks: dict[Path, torch.nn.Module] = {}
        if model.describer is not None:
            networks[self.output] = model.describer.net
        if isinstance(model.head, SuperGlueNet):
            matcher = self.output.with_name(f"{self.output.stem}-superglue.safetensors")
            networks[matcher if networks else self.output] = model.head
        for path, network in networks.items():
            tensors = {key: value.cpu().contiguous() for key, value in network.state_dict().items()}
            write_bytes(path, save(tensors))
        rows = [["" if v != v else f"{v:.6g}" for v in row] for row in state.rows]
        write_csv_table(self.output.with_suffix(".csv"), COLUMNS, rows)
        results = {name: asdict(result) for name, result in trainer.results.items()}
        write_json(self.manifest, {"training": record, "step": state.step, "held_out": results})
        # with it the rest is there
        more = {"step": state.step, "rows": state.rows}
        write_bytes(self.state, state_bytes(model, trainer.optimizer, more))
