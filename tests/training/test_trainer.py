"""The trainer on small images and random features: it learns, and resumes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import megloc_kapture as megloc
from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.features.superpoint import SuperPoint, SuperPointOptions
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.matching.networks import SuperGlue, SuperGlueOptions
from megloc_kapture.nets.superglue import SuperGlueNet
from megloc_kapture.stages.work import Work
from megloc_kapture.training.pairs import PosedPairs, TrainingPair
from megloc_kapture.training.train import DescriptorOptions, Trainer, TrainingOptions, train
from megloc_kapture.values import ImageFeatures

MAX_SIZE_PX = 200


def options(files: dict[str, str], kind: type[TrainingOptions] = TrainingOptions, **changes: Any):  # type: ignore[no-untyped-def]
    chosen = {"weights": files["xfeat"], "threshold": 0.0, "device": "cpu"}
    return kind.model_validate(
        {
            "features": {"name": "xfeat", "options": chosen},
            **{"device": "cpu", "max_size_px": MAX_SIZE_PX, "max_keypoints": 64, "layers": 4},
            **{"pairs_per_step": 2, "sinkhorn_iterations": 10, "steps": 6, "check_every": 2},
            **changes,
        }
    )


class Few:
    """Always the same pairs: drawn from all, or one after the other to be evaluated on."""

    def __init__(self, pairs: Sequence[TrainingPair], *, in_turn: bool = False) -> None:
        self.folder, self._pairs, self._in_turn, self._next = Path(), pairs, in_turn, 0

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        self._next += 1
        number = self._next if self._in_turn else int(rng.integers(len(self._pairs)))
        return self._pairs[number % len(self._pairs)]

    def counts(self) -> dict[str, int]:
        return {}


def overfitted(chosen: TrainingOptions, walk: Path) -> list[list[float]]:
    source = PosedPairs(KaptureFolder(walk), MAX_SIZE_PX)
    pairs = [source.draw(np.random.default_rng(seed)) for seed in range(8)]
    assert len({pair.keys for pair in pairs}) > 4
    trainer = Trainer(chosen)
    trainer.hold_out({"same": Few(pairs, in_turn=True)})
    before = trainer.evaluate()
    list(trainer.train([Few(pairs)]))
    return [before, trainer.rows[-1][3:]]


@pytest.mark.slow
@pytest.mark.parametrize("task", ["matcher", "descriptor"])
def test_eight_pairs_are_overfitted(task: str, files: dict[str, str], walk: Path) -> None:
    common = {"learning_rate": 1e-3, "held_out_pairs": 8}
    if task == "matcher":
        chosen = options(files, steps=300, check_every=300, pairs_per_step=4, **common)
    else:
        products = {"through": "products", "steps": 200, "check_every": 200}
        chosen = options(files, DescriptorOptions, **products, **common)
    (loss, before, *_), (last, precision, recall, *_) = overfitted(chosen, walk)
    assert last < loss / 10
    # nearest neighbours reject nothing that is mutual
    assert precision == 1.0 if task == "matcher" else precision > 2 * before
    assert recall > (0.99 if task == "matcher" else 0.95)


def interrupted_after(step: int) -> Work:
    def track(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
        for number, item in enumerate(items):
            if label.startswith("training") and number == step:
                raise KeyboardInterrupt
            yield item

    return Work(track=track)


# of descriptors the matcher is a part
@pytest.mark.slow
def test_a_resumed_training_equals_an_uninterrupted_one(
    files: dict[str, str],
    walk: Path,
    other_walk: Path,
    photographs: Path,
    tmp_path: Path,
) -> None:
    chosen = options(files, DescriptorOptions, held_out_pairs=3)
    data = {
        "kaptures": [KaptureFolder(walk)],
        "photographs": [photographs],
        "held_out": [KaptureFolder(other_walk)],
    }
    whole, parts = tmp_path / "whole" / "x.safetensors", tmp_path / "parts" / "x.safetensors"
    last = train(chosen, whole, **data)
    assert last["step"] == 6 and np.isfinite(list(last.values())).all()
    # in the middle between two that are kept, and at one
    for step in (3, 2):
        with pytest.raises(KeyboardInterrupt):
            train(chosen, parts, **data, work=interrupted_after(step))
    state = torch.load(parts.with_suffix(".state.pt"), weights_only=True)
    assert state["step"] == 4
    # threads change nothing beyond rounding
    assert train(chosen, parts, **data, threads=3) == pytest.approx(last, rel=1e-5)
    names = ["x.csv", "x.json", "x.safetensors", "x.state.pt", "x.overlaps"]
    names += ["x-superglue.safetensors"]
    assert sorted(path.name for path in parts.parent.iterdir()) == sorted(names)
    assert len(list((parts.parent / "x.overlaps").iterdir())) == 2
    # what is done is done
    before = parts.stat().st_mtime_ns
    assert train(chosen, parts, **data) == pytest.approx(last, rel=1e-5)
    assert parts.stat().st_mtime_ns == before
    manifest = json.loads(parts.with_suffix(".json").read_text())
    record = manifest["training"]
    assert [source["images"] for source in record["data"].values()] == [5, 1]
    assert record["task"] == "descriptor"
    lines = parts.with_suffix(".csv").read_text().splitlines()
    assert lines[0].startswith("step,learning_rate,loss,") and len(lines) == 4


def test_seed_precision_and_initial_weights(
    files: dict[str, str], walk: Path, tmp_path: Path
) -> None:
    data = [KaptureFolder(walk)]
    first = tmp_path / "first.safetensors"
    whole = train(options(files, steps=2, layers=2), first, kaptures=data)
    in_half = options(files, steps=2, layers=2, half_precision=True)
    half = train(in_half, tmp_path / "half.safetensors", kaptures=data)
    assert whole["loss"] != half["loss"]
    assert whole["loss"] == pytest.approx(half["loss"], rel=0.05)
    train(options(files, steps=2, layers=2, seed=1), tmp_path / "second.safetensors", kaptures=data)
    assert first.read_bytes() != (tmp_path / "second.safetensors").read_bytes()
    # on from there, with small steps, is near there
    third = tmp_path / "third.safetensors"
    more = options(files, steps=1, layers=2, matcher_weights=str(first), learning_rate=1e-7)
    train(more, third, kaptures=data)
    for key, value in load_file(first).items():
        if value.ndim == 3:
            torch.testing.assert_close(load_file(third)[key], value, rtol=0, atol=1e-5)


def test_superpoint_descriptors_are_trained_and_read(
    files: dict[str, str], walk: Path, tmp_path: Path
) -> None:
    """Random weights: detector frozen, gradients through SuperGlue into the descriptors."""
    frozen = {"weights": files["superpoint"], "device": "cpu", "threshold": 0.0}
    output = tmp_path / "night.safetensors"
    changes = {"features.options": frozen, "steps": 1, "layers": 2, "pairs_per_step": 1}
    changes |= {"device": "cpu", "max_size_px": MAX_SIZE_PX, "max_keypoints": 60}
    changes |= {"learning_rate": 1e-3, "sinkhorn_iterations": 10, "check_every": 2}
    last = megloc.train("descriptor", output, kaptures=[walk], features="superpoint", set=changes)
    assert last["step"] == 1 and np.isfinite(last["loss"])
    before, after = load_file(files["superpoint"]), load_file(output)
    assert set(after) == {key for key in before if not key.startswith("convP")}
    assert all(not torch.equal(after[key], before[key]) for key in after)
    image = read_image_rgb(walk / "sensors" / "records_data" / "1.png")
    weights = {"max_keypoints": 60, "descriptor_weights": str(output)}
    split = SuperPoint(SuperPointOptions(**frozen, **weights)).extract(image)
    matcher = SuperGlue(
        SuperGlueOptions(weights=str(tmp_path / "night-superglue.safetensors"), device="cpu")
    )
    side = ImageFeatures(split.keypoints_px, split.descriptors, 400, 300)
    assert len(matcher.match(side, side)[0]) <= 60


def test_invalid_training_is_refused(
    files: dict[str, str], walk: Path, photographs: Path, tmp_path: Path
) -> None:
    data = {"kaptures": [KaptureFolder(walk)]}
    output = tmp_path / "x.safetensors"
    chosen = options(files, steps=1, layers=2)
    for wrong, message in (
        ({}, "nothing to train on"),
        ({**data, "held_out": [KaptureFolder(walk)]}, "and held out"),
    ):
        with pytest.raises(OptionError, match=message):
            train(chosen, output, **wrong)
    with pytest.raises(OptionError, match="end in .safetensors"):
        train(chosen, tmp_path / "x.pth", **data)
    with pytest.raises(OptionError, match="smaller learning_rate"):
        train(options(files, learning_rate=1e30), output, **data)
    assert not output.exists()
    train(chosen, output, **data)
    with pytest.raises(OutputError, match=r"x\.json: is from another training \(options\); -f"):
        train(options(files, steps=2), output, **data)
    output.with_suffix(".state.pt").write_bytes(b"PK damaged")
    with pytest.raises(
        DataError, match=r"x\.state\.pt: is damaged, or the state of another training"
    ):
        train(chosen, output, **data)
    assert train(options(files, steps=2), output, **data, force=True)["step"] == 2
    mine = tmp_path / "mine.safetensors"
    mine.write_bytes(b"of somebody else")
    with pytest.raises(OutputError, match="not the output of a training"):
        train(chosen, mine, **data)
    assert mine.read_bytes() == b"of somebody else"
    with pytest.raises(OptionError, match=r"256 dimensions; xfeat has 64"):
        official = tmp_path / "official.safetensors"
        save_file(SuperGlueNet(num_layers=2).state_dict(), official)
        train(options(files, matcher_weights=str(official)), tmp_path / "y.safetensors", **data)
