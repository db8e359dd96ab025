"""Training of matchers and descriptors: a seeded loop, its options and its files.

A step's pairs depend on seed and step only, so the state consists of networks, optimizer, step and
curves.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from safetensors.torch import save

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import read_content, remove, write_bytes, write_json
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.runtime import (
    NetworkOptions,
    load_state,
    pick_device,
    state_bytes,
    without_tf32,
)
from megloc_kapture.nets.superglue import SuperGlueNet, superglue
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES, LocalFeatureExtractor, PluginChoice
from megloc_kapture.stages.work import HERE, Work, ordered_map
from megloc_kapture.training.networks import (
    AUC_DEG,
    HeldOutResult,
    PairModel,
    PreparedPair,
    ProductHead,
    begin_at_products,
    describer_of,
    encoder_sizes,
    held_out_result,
)
from megloc_kapture.training.pairs import PairSource, Photographs, PosedPairs, TrainingPair
from megloc_kapture.values import ImageFeatures

COLUMNS = (
    *("step", "learning_rate", "loss", "held_out_loss", "precision", "recall"),
    *(f"auc_{bound}" for bound in AUC_DEG),
)
_FEATURES_KEPT = 1024  # number of images whose features are cached
_LAST_RATE = 0.01  # relative to the initial rate
_MAX_GRADIENT = 1.0  # norm


class TrainingOptions(NetworkOptions):
    """Options for training SuperGlue on a frozen extractor's features."""

    half_precision: bool = Field(
        default=False, description="bfloat16, except for keypoint positions, transport and loss"
    )
    features: PluginChoice = PluginChoice(name="superpoint")
    max_keypoints: int = Field(default=512, gt=0, description="number of best keypoints per image")
    max_size_px: int = Field(default=640, ge=64, description="longer side of the reduced images")
    steps: int = Field(default=100_000, gt=0)
    pairs_per_step: int = Field(default=16, gt=0, description="number of pairs per batch")
    learning_rate: float = Field(
        default=1e-4,
        gt=0,
        description="learning rate of Adam in the first half of the steps; then it decays to 1 %",
    )
    layers: int = Field(
        default=18,
        gt=0,
        multiple_of=2,
        description="number of attention layers, alternating self and cross",
    )
    sinkhorn_iterations: int = Field(
        default=50, gt=0, description="iterations in training and evaluation"
    )
    matcher_weights: str | None = Field(
        default=None,
        description="initial SuperGlue; none: a new one that starts as a nearest-neighbour matcher",
    )
    check_every: int = Field(
        default=1000, gt=0, description="steps between evaluations and checkpoints"
    )
    held_out_pairs: int = Field(
        default=100, gt=0, description="number of pairs per held-out folder"
    )
    seed: int = Field(default=0, ge=0)


class DescriptorOptions(TrainingOptions):
    """Options for training a descriptor network with a frozen detector."""

    through: Literal["superglue", "products"] = Field(
        default="superglue",
        description="superglue: trained together with SuperGlue, as in MegLoc; products: trained "
        "for nearest-neighbour matching",
    )


def model_of(options: TrainingOptions, extractor: LocalFeatureExtractor) -> PairModel:
    # extract from an image to learn the size, since plugins need not have descriptor_size
    noise = np.random.default_rng(0).integers(0, 256, (128, 128, 3), np.uint8)
    size = extractor.extract(noise).descriptors.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        head: SuperGlueNet | ProductHead
        if isinstance(options, DescriptorOptions) and options.through == "products":
            head = ProductHead()
        elif options.matcher_weights is not None:
            file = find_weights(options.matcher_weights)
            head = superglue(read_weights(file), str(file.path))
        else:
            head = SuperGlueNet(encoder_sizes(size), options.layers)
            begin_at_products(head)
        if isinstance(head, SuperGlueNet) and head.descriptor_size != size:
            raise OptionError(
                f"matcher_weights={options.matcher_weights} are for descriptors of "
                f"{head.descriptor_size} dimensions; {options.features.name} has {size}"
            )
        describer = describer_of(extractor) if isinstance(options, DescriptorOptions) else None
        return PairModel(head, describer, iterations=options.sinkhorn_iterations)


class Trainer:
    """A seeded training run; ``rows`` are its curves up to ``step``: COLUMNS, NaN if unknown."""

    def __init__(self, options: TrainingOptions) -> None:
        self.options = options
        self.step = 0
        self.rows: list[list[float]] = []
        choice = options.features
        self.extractor = load_plugin(LOCAL_FEATURES, choice.name, choice.options)
        self._kept: dict[str, ImageFeatures] = {}
        self._device = pick_device(options.device)
        self.model = model_of(options, self.extractor).to(self._device)
        trained = [p for p in self.model.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(trained, lr=options.learning_rate)
        self._held_out: dict[str, list[PreparedPair]] = {}
        # last evaluation by held-out source
        self.results: dict[str, HeldOutResult] = {}

    def resume(self, path: Path) -> None:
        """Continue from a state file."""
        content = load_state(read_content(path), path, self.model, self.optimizer)
        self.step, self.rows = content["step"], [list(map(float, row)) for row in content["rows"]]

    def train(
        self, sources: Sequence[PairSource], work: Work = HERE, *, threads: int = 1
    ) -> Iterator[int]:
        """Train on pairs drawn evenly from the sources; yield the step after each evaluation."""
        options, losses = self.options, []
        steps = range(self.step, options.steps)
        threaded = ThreadPoolExecutor(threads) if threads > 1 else nullcontext()
        # disable TF32 for all threads: feature extraction in a thread would toggle it during a step
        with without_tf32(self._device), threaded as pool:
            prepared = ordered_map(
                lambda step: self._pairs(sources, step), steps, pool, window=2 * threads
            )
            batches = work.track(prepared, len(steps), f"training {options.steps} steps")
            for step, batch in zip(steps, batches, strict=True):
                losses.append(self._step(step, batch))
                if (step + 1) % options.check_every and step + 1 < options.steps:
                    continue
                row = [float(step + 1), self._rate(step), float(np.mean(losses))]
                self.step, losses = step + 1, []
                self.rows.append([*row, *self.evaluate()])
                yield self.step

    def hold_out(self, sources: Mapping[str, PairSource]) -> None:
        """Draw the evaluation pairs of each source."""
        self._held_out = {
            name: [
                self.prepare(source.draw(np.random.default_rng([0, number])))
                for number in range(self.options.held_out_pairs)
            ]
            for name, source in sources.items()
        }

    def evaluate(self) -> list[float]:
        """Return the fourth and later COLUMNS: means over held-out sources, NaN without any."""
        self.model.eval()
        self.results = {
            name: held_out_result(self.model, pairs) for name, pairs in self._held_out.items()
        }
        if not self.results:
            return [float("nan")] * (len(COLUMNS) - 3)
        rows = [(r.loss, r.precision, r.recall, *r.auc) for r in self.results.values()]
        return [float(value) for value in np.mean(rows, axis=0)]

    def _step(self, step: int, batch: Sequence[PreparedPair]) -> float:
        options = self.options
        for parameters in self.optimizer.param_groups:
            parameters["lr"] = self._rate(step)
        self.model.train()
        self.optimizer.zero_grad(set_to_none=True)
        with torch.autocast(
            self._device.type, dtype=torch.bfloat16, enabled=options.half_precision
        ):
            loss = self.model(batch)
        value = float(loss.detach())
        if not np.isfinite(value):
            raise OptionError(
                f"the loss of step {step + 1} is {value}; start over with a smaller learning_rate"
            )
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), _MAX_GRADIENT)
        self.optimizer.step()
        return value

    def _rate(self, step: int) -> float:
        half = self.options.steps / 2
        return self.options.learning_rate * _LAST_RATE ** max(0.0, (step - half) / half)

    def _pairs(self, sources: Sequence[PairSource], step: int) -> list[PreparedPair]:
        batch = []
        for number in range(self.options.pairs_per_step):
            rng = np.random.default_rng([self.options.seed, step, number])
            source = sources[int(rng.integers(len(sources)))]
            batch.append(self.prepare(source.draw(rng)))
        return batch

    def prepare(self, pair: TrainingPair) -> PreparedPair:
        """Extract and label a pair's best keypoints."""
        keys = pair.keys or (None, None)
        a, b = (self._features(image, key) for image, key in zip(pair.images, keys, strict=True))
        labels = pair.label(a.keypoints_px[:, :2], b.keypoints_px[:, :2])
        return PreparedPair(pair, (a, b), labels)

    def _features(self, image: NDArray[np.uint8], key: str | None) -> ImageFeatures:
        """Return the best features of an image; those with a key are cached."""
        if key is not None and key in self._kept:
            return self._kept[key]
        extracted, best = self.extractor.extract(image), slice(self.options.max_keypoints)
        height, width = image.shape[:2]
        features = ImageFeatures(
            extracted.keypoints_px[best], extracted.descriptors[best], width, height
        )
        if key is not None and len(self._kept) < _FEATURES_KEPT:
            self._kept[key] = features
        return features


TASKS: dict[str, type[TrainingOptions]] = {
    "matcher": TrainingOptions,
    "descriptor": DescriptorOptions,
}


def train(
    options: TrainingOptions,
    output: Path,
    *,
    kaptures: Sequence[KaptureFolder] = (),
    photographs: Sequence[Path] = (),
    held_out: Sequence[KaptureFolder] = (),
    force: bool = False,
    threads: int = 1,
    work: Work = HERE,
) -> dict[str, float]:
    """Train a matcher, or descriptors with :class:`DescriptorOptions`, to the last step.

    Each evaluation writes ``output`` (``X.safetensors``), for descriptors trained through SuperGlue
    also ``X-superglue.safetensors``, the manifest ``X.json``, the curves ``X.csv`` and
    ``X.state.pt``, from which the same call resumes. ``X.overlaps`` caches the overlap of image
    pairs. Returns the last row of the curves.

    Parameters
    ----------
    kaptures, held_out : with poses and depth; ``held_out`` for evaluation only.
    photographs : folders of images, for homographies.
    force : replace another training run's files.
    threads : number of threads that prepare pairs.
    """
    if output.suffix != ".safetensors":
        raise OptionError(f"{output}: the file to write must end in .safetensors")
    _check_data(kaptures, photographs, held_out)
    trainer, manifest = Trainer(options), output.with_suffix(".json")
    state, overlaps = output.with_suffix(".state.pt"), output.with_suffix(".overlaps")
    resumes = not force and (output.exists() or manifest.exists())
    if not resumes:
        remove(state)
        remove(overlaps)
    posed = [
        PosedPairs(folder, options.max_size_px, work, overlaps / f"{number:03d}.txt")
        for number, folder in enumerate([*kaptures, *held_out])
    ]
    sources: list[PairSource] = [*posed[: len(kaptures)]]
    sources += [Photographs(folder, options.max_size_px) for folder in photographs]
    evaluated = {source.folder.name: source for source in posed[len(kaptures) :]}
    record = {
        "task": next(name for name, kind in TASKS.items() if kind is type(options)),
        "options": json.loads(options.model_dump_json()),
        "weights": getattr(trainer.extractor, "weights", dict)(),
        "data": {source.folder.name: source.counts() for source in sources},
        "held_out_data": {name: source.counts() for name, source in evaluated.items()},
    }
    if resumes:
        _check_same_training(output, record)
    if state.is_file():
        trainer.resume(state)
    if trainer.step < options.steps:
        trainer.hold_out(evaluated)
    for _ in trainer.train(sources, work, threads=threads):
        _write(trainer, output, record)
    return dict(zip(COLUMNS, trainer.rows[-1], strict=True)) if trainer.rows else {}


def _check_data(
    kaptures: Sequence[KaptureFolder],
    photographs: Sequence[Path],
    held_out: Sequence[KaptureFolder],
) -> None:
    if not (kaptures or photographs):
        raise OptionError("nothing to train on: give a kapture with depth, or photographs")
    trained, evaluated = ({f.root.resolve() for f in folders} for folders in (kaptures, held_out))
    if both := trained & evaluated:
        raise OptionError(f"{min(both)}: is used for training and held out")
    if len({folder.root.name for folder in held_out}) < len(held_out):
        raise OptionError("held-out folders need different names")


def _check_same_training(output: Path, record: Mapping[str, Any]) -> None:
    """Raise OutputError unless the existing files are from the same training run."""
    manifest = output.with_suffix(".json")
    try:
        known = json.loads(read_content(manifest)).get("training")
    except (DataError, ValueError, AttributeError):
        known = None
    if known is None:
        raise OutputError(f"{output}: not the output of a training run; -f replaces it")
    if known != record:
        changed = sorted(k for k in {*known, *record} if known.get(k) != record.get(k))
        raise OutputError(
            f"{manifest}: is from another training run ({', '.join(changed)}); -f starts over"
        )


def _write(trainer: Trainer, output: Path, record: Mapping[str, Any]) -> None:
    model = trainer.model
    networks: dict[Path, torch.nn.Module] = {}
    if model.describer is not None:
        networks[output] = model.describer.net
    if isinstance(model.head, SuperGlueNet):
        matcher = output.with_name(f"{output.stem}-superglue.safetensors")
        networks[matcher if networks else output] = model.head
    for path, network in networks.items():
        tensors = {key: value.cpu().contiguous() for key, value in network.state_dict().items()}
        write_bytes(path, save(tensors))
    rows = [["" if v != v else f"{v:.6g}" for v in row] for row in trainer.rows]
    write_csv_table(output.with_suffix(".csv"), COLUMNS, rows)
    results = {name: asdict(result) for name, result in trainer.results.items()}
    manifest = {"training": record, "step": trainer.step, "held_out": results}
    write_json(output.with_suffix(".json"), manifest)
    # written last, so that the other files are never older than the state
    progress = {"step": trainer.step, "rows": trainer.rows}
    write_bytes(output.with_suffix(".state.pt"), state_bytes(model, trainer.optimizer, progress))
