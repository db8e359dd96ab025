"""Training from folders to files: networks, curves, a manifest of what went into them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import read_content, remove, write_bytes, write_json
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import by_sha256, find_weights, sha256_of
from megloc_kapture.nets.runtime import pick_device, state_bytes
from megloc_kapture.nets.superglue import SuperGlueNet
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.training.pairs import (
    PairOptions,
    PairSource,
    Photographs,
    PosedPairs,
    sha256_of_files,
)
from megloc_kapture.training.trainer import (
    COLUMNS,
    DescriptorOptions,
    ProcessGroup,
    Trainer,
    TrainingOptions,
    TrainingState,
)

UNKNOWN_LICENCE = "unknown"
TASKS: dict[str, type[TrainingOptions]] = {
    "matcher": TrainingOptions,
    "descriptor": DescriptorOptions,
}


@dataclass(frozen=True)
class TrainingData:
    """The data of a training."""

    kaptures: Sequence[KaptureFolder] = ()  # with poses and depth
    photographs: Sequence[Path] = ()  # folders of images, trained on under homographies
    # kaptures that are only evaluated on; no folder of ``kaptures`` may be one
    held_out: Sequence[KaptureFolder] = ()
    # of the folders, by their paths as they are given; others are unknown
    licences: Mapping[Path, str] = field(default_factory=dict)

    def check(self, options: TrainingOptions) -> None:
        """Raise OptionError for what contradicts itself or changes nothing."""
        trained = [folder.root for folder in self.kaptures]
        if not (trained or self.photographs):
            raise OptionError("nothing to train on: give a kapture with depth, or photographs")
        both = {path.resolve() for path in trained} & {f.root.resolve() for f in self.held_out}
        if both:
            raise OptionError(f"{min(both)}: is trained on and held out")
        known = {*trained, *self.photographs, *(folder.root for folder in self.held_out)}
        for path in self.licences:
            if path not in known:
                raise OptionError(f"a licence of {path}, which is no folder of this training")
        if len({folder.root.name for folder in self.held_out}) < len(self.held_out):
            raise OptionError("held-out folders need different names")
        pairs, usual = options.pairs, PairOptions()
        unused = []
        if not self.photographs and pairs.homographies != usual.homographies:
            unused.append(("pairs.homographies", "photographs"))
        if not (self.kaptures or self.held_out):
            if pairs.overlap_bins != usual.overlap_bins:
                unused.append(("pairs.overlap_bins", "kapture folders"))
            if pairs.labels.max_depth_error != usual.labels.max_depth_error:
                unused.append(("pairs.labels.max_depth_error", "kapture folders"))
        if not self.held_out and options.held_out_pairs != TrainingOptions().held_out_pairs:
            unused.append(("held_out_pairs", "held-out folders"))
        for name, absent in unused:
            raise OptionError(f"{name} changes nothing: there are no {absent}")


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

    Written at each evaluation, beside each other: ``output``, of descriptors that are trained
    through SuperGlue also ``X-superglue.safetensors``, the manifest ``X.json``, the curves
    ``X.csv`` and ``X.state.pt``, from which the same call goes on; before, ``X.overlaps``. Returns
    the last row of the curves by column. Raises OptionError, DataError, MissingWeightsError:
    options, data or weights cannot be used; OutputError: files of another training stand there, or
    they cannot be written.

    Parameters
    ----------
    output : the file to write, ``X.safetensors``.
    force : begin again where another training's files stand.
    threads : that prepare pairs.
    """
    if output.suffix != ".safetensors":
        raise OptionError(f"{output}: the file to write must end in .safetensors")
    data.check(options)
    files = _Files(output)
    with ProcessGroup.join(pick_device(options.device)) as group:
        trainer = Trainer(options)
        if group.rank:
            group.wait()  # for the first one's measurements
        else:
            files.begin(force=force)
        posed = [
            PosedPairs(folder, options.pairs, work, files.overlaps / f"{number:03d}.txt")
            for number, folder in enumerate([*data.kaptures, *data.held_out])
        ]
        if not group.rank:
            group.wait()
        sources: list[PairSource] = [*posed[: len(data.kaptures)]]
        sources += [Photographs(folder, options.pairs) for folder in data.photographs]
        held_out = {source.folder.name: source for source in posed[len(data.kaptures) :]}
        record = {}
        if group.rank == 0:
            record = _record(options, trainer, sources, held_out, data.licences)
            files.claim(record, force=force)
        group.wait()
        state = TrainingState.resume(files.state, trainer.model, trainer.optimizer)
        if group.rank == 0 and state.step < options.steps:
            trainer.hold_out(held_out)
        for reached in trainer.train(sources, state, group, work, threads=threads):
            state = reached
            files.write(trainer, state, record)
    return dict(zip(COLUMNS, state.rows[-1], strict=True)) if state.rows else {}


class _Files:
    """The files of one training; ``overlaps`` is a folder, of measured overlaps of pairs."""

    def __init__(self, output: Path) -> None:
        self.output = output
        self.state, self.manifest = output.with_suffix(".state.pt"), output.with_suffix(".json")
        self.overlaps = output.with_suffix(".overlaps")

    def begin(self, *, force: bool) -> None:
        """Remove what training would go on from, where none was begun, or it begins again."""
        if force or not (self.output.exists() or self.manifest.exists()):
            remove(self.state)
            remove(self.overlaps)

    def claim(self, record: Mapping[str, Any], *, force: bool) -> None:
        """Refuse what is not this training's."""
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
        sums = {}
        if model.describer is not None:
            networks[self.output] = model.describer.net
        if isinstance(model.head, SuperGlueNet):
            matcher = self.output.with_name(f"{self.output.stem}-superglue.safetensors")
            networks[matcher if networks else self.output] = model.head
        for path, network in networks.items():
            tensors = {key: value.cpu().contiguous() for key, value in network.state_dict().items()}
            content = save(tensors)
            write_bytes(path, content)
            sums[path.name] = hashlib.sha256(content).hexdigest()
        rows = [["" if v != v else f"{v:.6g}" for v in row] for row in state.rows]
        write_csv_table(self.output.with_suffix(".csv"), COLUMNS, rows)
        manifest = {
            "training": record,
            "step": state.step,
            "held_out": {name: asdict(result) for name, result in trainer.results.items()},
            "files": sums,
            "versions": {name: version(name) for name in ("megloc-kapture", "torch")},
        }
        write_json(self.manifest, manifest)
        # with it the rest is there
        more = {"step": state.step, "rows": state.rows}
        write_bytes(self.state, state_bytes(model, trainer.optimizer, more))


def _record(
    options: TrainingOptions,
    trainer: Trainer,
    sources: Sequence[PairSource],
    held_out: Mapping[str, PairSource],
    licences: Mapping[Path, str],
) -> dict[str, Any]:
    """What determines a training: two with the same are the same."""
    weights: dict[str, str] = getattr(trainer.extractor, "weights", dict)()
    if options.matcher_weights is not None:
        file = find_weights(options.matcher_weights)
        weights = {**weights, file.path.name: sha256_of(file)}
    return {
        "task": next(name for name, kind in TASKS.items() if kind is type(options)),
        "options": json.loads(options.model_dump_json()),
        "weights": [
            {"file": name, "sha256": sha256, "licence": _licence_of(sha256)}
            for name, sha256 in sorted(weights.items())
        ],
        "data": [_described(source, licences) for source in sources],
        "held_out_data": [_described(source, licences) for source in held_out.values()],
    }


def _described(source: PairSource, licences: Mapping[Path, str]) -> dict[str, Any]:
    return {
        "folder": source.folder.name,
        "licence": licences.get(source.folder, UNKNOWN_LICENCE),
        **source.counts(),
        "sha256": sha256_of_files(source.folder, list(source.files())),
    }


def _licence_of(sha256: str) -> str:
    return UNKNOWN_LICENCE if (known := by_sha256(sha256)) is None else known[0].licence
