"""The trainer learns and resumes; networks in training, the loss, figures of held-out pairs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from corner import pose_at
from images import texture
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from scipy.spatial.transform import Rotation
from torch import nn

import megloc_kapture as megloc
from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.features.kornia_features import XFeat, XFeatOptions
from megloc_kapture.features.rootsift import RootSift
from megloc_kapture.features.superpoint import SuperPoint, SuperPointOptions
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.matching.networks import SuperGlue, SuperGlueOptions
from megloc_kapture.nets.superglue import ImageKeypoints, SuperGlueNet
from megloc_kapture.stages.work import Work
from megloc_kapture.training.labels import IGNORED, UNMATCHED, Labels
from megloc_kapture.training.networks import (
    PairModel,
    PreparedPair,
    ProductHead,
    XFeatDescriber,
    begin_at_products,
    describer_of,
    encoder_sizes,
    judged,
    pose_auc,
    pose_error_deg,
    relative_pose_error_deg,
    transport_loss,
)
from megloc_kapture.training.pairs import PosedPairs, TrainingPair
from megloc_kapture.training.train import DescriptorOptions, Trainer, TrainingOptions, train
from megloc_kapture.values import ImageFeatures, RigidTransform

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
    files: dict[str, str], walk: Path, other_walk: Path, photographs: Path, tmp_path: Path
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
    last = megloc.train(
        "descriptor", output, kaptures=str(walk), features="superpoint", set=changes
    )
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
    with pytest.raises(OutputError, match=r"x\.json: is from another training run \(options\); -f"):
        train(options(files, steps=2), output, **data)
    output.with_suffix(".state.pt").write_bytes(b"PK damaged")
    with pytest.raises(DataError, match=r"x\.state\.pt: is damaged or from another training run"):
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


NOTHING = Labels(np.zeros(0, np.int64), np.zeros(0, np.int64))
LABELS = Labels(
    np.array([2, UNMATCHED, IGNORED, 0, UNMATCHED]), np.array([3, IGNORED, 0, UNMATCHED])
)


def random_side(count: int, size: int, seed: int, dtype: torch.dtype = torch.float32):  # type: ignore[no-untyped-def]
    draw = torch.Generator().manual_seed(seed)
    unit = nn.functional.normalize(torch.randn(count, size, generator=draw), dim=1)
    at, scores = torch.rand(count, 2, generator=draw), torch.rand(count, generator=draw)
    return ImageKeypoints(at.to(dtype), scores.to(dtype), unit.to(dtype))


def extractors(files: dict[str, str]) -> list[SuperPoint | XFeat]:
    return [
        SuperPoint(SuperPointOptions(weights=files["superpoint"], device="cpu")),
        XFeat(XFeatOptions(weights=files["xfeat"], device="cpu", threshold=0.0)),
    ]


def test_describers_start_with_the_extractor_s_descriptors(files: dict[str, str]) -> None:
    # no multiple of 32: XFeat resizes it
    image = texture(116, 150)
    for extractor in extractors(files):
        result = extractor.extract(image)
        assert len(result.scores) > 30
        xy_px = torch.from_numpy(result.keypoints_px[:, :2].copy())
        described = describer_of(extractor).train()(image, xy_px)
        assert described.requires_grad
        np.testing.assert_allclose(described.detach().numpy(), result.descriptors, atol=2e-5)


def test_a_new_superglue_matches_by_descriptor_products() -> None:
    pair = random_side(7, 64, 0), random_side(5, 64, 1)
    net = SuperGlueNet(encoder_sizes(64), 4).train()
    (products,) = ProductHead()([pair], 20)
    assert not torch.allclose(net([pair], 20)[0], products, atol=0.1)
    begin_at_products(net)
    (result,) = net([pair], 20)
    torch.testing.assert_close(result, products, atol=1e-4, rtol=1e-4)
    # all of it can learn
    result[0, 0].backward()
    for layer in net.gnn.layers:
        assert layer.mlp[-1].weight.grad.abs().sum() > 0
    assert net.kenc.encoder[-1].weight.grad.abs().sum() > 0


def test_trained_weights_are_read_as_descriptor_weights(
    files: dict[str, str], tmp_path: Path
) -> None:
    image = texture(64, 96)
    for extractor in extractors(files):
        before = extractor.extract(image)
        describer = describer_of(extractor)
        with torch.no_grad():
            for parameter in describer.parameters():
                if parameter.requires_grad and parameter.ndim == 4:
                    parameter += 0.03 * torch.randn_like(parameter)
        path = tmp_path / f"night_{extractor.name}.safetensors"
        save_file({k: v.contiguous() for k, v in describer.net.state_dict().items()}, path)
        options = extractor.options.model_copy(update={"descriptor_weights": str(path)})
        split = type(extractor)(options)  # type: ignore[arg-type]
        assert split.name == f"{extractor.name}-{path.stem}" != extractor.name
        assert path.name in split.weights() and len(split.weights()) == 2
        after = split.extract(image)
        # the detector is frozen
        np.testing.assert_array_equal(after.keypoints_px, before.keypoints_px)
        xy_px = torch.from_numpy(after.keypoints_px[:, :2].copy())
        np.testing.assert_allclose(
            after.descriptors, describer(image, xy_px).detach().numpy(), atol=2e-5
        )
        cosine = (after.descriptors * before.descriptors).sum(axis=1)
        assert cosine.max() < 0.9999
        # and training goes on from there
        again = describer_of(split)(image, xy_px).detach().numpy()
        np.testing.assert_allclose(again, after.descriptors, atol=2e-5)


def test_xfeat_keeps_its_statistics(files: dict[str, str]) -> None:
    describer = describer_of(extractors(files)[1]).train()
    assert isinstance(describer, XFeatDescriber)
    before = {key: value.clone() for key, value in describer.net.named_buffers()}
    describer(texture(96, 128), torch.tensor([[30.0, 40.0]])).sum().backward()
    for key, value in describer.net.named_buffers():
        assert torch.equal(value, before[key]), key
    trained = {name for name, p in describer.net.named_parameters() if p.grad is not None}
    assert any(name.startswith("block5") for name in trained)
    assert not any(name.startswith(("heatmap", "keypoint")) for name in trained)


def test_frozen_features_are_the_best_and_kept(files: dict[str, str]) -> None:
    trainer = Trainer(options(files, max_keypoints=20))
    images = texture(96, 128), texture(80, 96, 1)
    labelled: list[tuple[int, int]] = []

    def label(px_a: NDArray[np.float64], px_b: NDArray[np.float64]) -> Labels:
        labelled.append((len(px_a), len(px_b)))
        return NOTHING

    first = trainer.prepare(TrainingPair(images, ("a", "b"), label))
    assert labelled == [(20, 20)]
    a, b = first.features
    result = trainer.extractor.extract(images[0])
    np.testing.assert_array_equal(a.keypoints_px, result.keypoints_px[:20])
    again = trainer.prepare(TrainingPair(images, ("b", "c"), label))
    assert again.features[0] is b and again.features[1] is not b
    assert trainer.prepare(TrainingPair(images, None, label)).features[0] is not a


def test_a_pair_without_keypoints_has_no_loss(files: dict[str, str]) -> None:
    blank = np.zeros((64, 64, 3), np.uint8)
    chosen = {"weights": files["superpoint"], "device": "cpu", "threshold": 0.9}
    trainer = Trainer(options(files, features={"name": "superpoint", "options": chosen}))
    pair = trainer.prepare(TrainingPair((blank, blank), None, lambda a, b: NOTHING))
    model = PairModel(SuperGlueNet(encoder_sizes(256), 2), None, iterations=5)
    loss = model([pair])
    loss.backward()
    assert loss.item() == 0 and len(model.match(pair)[0]) == 0


def test_unsuitable_networks_are_refused(files: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="superpoint and xfeat can be trained, not those of root"):
        describer_of(RootSift())
    assert encoder_sizes(256) == (32, 64, 128, 256, 256)
    with pytest.raises(OptionError, match="multiple of 8, not 100"):
        encoder_sizes(100)
    options = SuperPointOptions(weights=files["xfeat"], device="cpu")
    with pytest.raises(DataError, match="does not fit SuperPointNet"):
        describer_of(SuperPoint(options))


def test_loss_is_the_likelihood_of_labels() -> None:
    log = torch.log_softmax(torch.randn(6, 5, generator=torch.Generator().manual_seed(0)), dim=1)
    matched = (log[0, 2] + log[3, 0]) / 2
    unmatched = (log[1, 4] + log[4, 4] + log[5, 3]) / 3
    torch.testing.assert_close(transport_loss(log, LABELS), -(matched + unmatched) / 2)
    # what is ignored changes nothing
    log[2, :], log[:, 1] = 7.0, -3.0
    torch.testing.assert_close(transport_loss(log, LABELS), -(matched + unmatched) / 2)
    # nothing labelled is no loss
    log = torch.zeros(4, 3, requires_grad=True)
    nothing = Labels(np.full(3, IGNORED), np.full(2, IGNORED))
    assert transport_loss(log, nothing).item() == 0
    lost = Labels(np.array([UNMATCHED, IGNORED, IGNORED]), np.full(2, IGNORED))
    transport_loss(log - 2, lost).backward()
    assert log.grad is not None and log.grad.nonzero().tolist() == [[0, 2]]


def test_matches_are_judged_by_labels() -> None:
    labels = Labels(np.array([1, UNMATCHED, IGNORED, IGNORED]), np.array([IGNORED, 0, UNMATCHED]))
    matches = np.array([[0, 1], [1, 0], [2, 0], [3, 2]])
    right, has_label = judged(matches, labels)
    assert right.tolist() == [True, False, False, False]
    assert has_label.tolist() == [True, True, False, True]


def test_pose_auc() -> None:
    # half of the poses are perfect
    assert pose_auc([0.0, np.inf]) == pytest.approx((0.5, 0.5, 0.5))
    assert pose_auc([]) == (0.0, 0.0, 0.0)
    assert pose_auc([90.0]) == (0.0, 0.0, 0.0)
    # errors spread evenly over 0 to 20 degrees: recall is the line error / 20
    even = np.linspace(0, 20, 20001)
    assert pose_auc(even) == pytest.approx((0.125, 0.25, 0.5), abs=1e-3)


def test_relative_pose_error() -> None:
    truth = pose_at((1.0, 0, 0), 0, 0)
    turned = RigidTransform.from_matrix(
        Rotation.from_euler("z", 7, degrees=True).as_matrix(), np.array(truth.translation)
    )
    assert relative_pose_error_deg(turned, truth) == pytest.approx(7)
    sideways = RigidTransform((1.0, 0.0, 0.0, 0.0), (-1.0, 0.2, 0.0))
    expected = np.degrees(np.arctan(0.2))
    assert relative_pose_error_deg(sideways, truth) == pytest.approx(expected)
    # its sign is left open; of one centre there is no translation
    away = RigidTransform((1.0, 0.0, 0.0, 0.0), (1.0, 0.2, 0.0))
    assert relative_pose_error_deg(away, truth) == pytest.approx(expected)
    still = RigidTransform.identity()
    assert relative_pose_error_deg(turned, still) == pytest.approx(7)


def test_true_matches_give_the_true_pose(walk: Path) -> None:
    pair = PosedPairs(KaptureFolder(walk), 640).draw(np.random.default_rng(0))
    assert pair.views is not None
    points = np.random.default_rng(1).uniform((-3, -2, 4), (1, 2, 6), (200, 3))
    sides = []
    for view in pair.views:
        px = project(view.camera, view.cam_from_world, points).astype(np.float32)
        sides.append(ImageFeatures(px, np.zeros((200, 8), np.float32), 400, 300))
    inside = np.all([(s.keypoints_px > 0) & (s.keypoints_px < (400, 300)) for s in sides], (0, 2))
    rows = np.flatnonzero(inside)
    nothing = Labels(np.zeros(200, np.int64), np.zeros(200, np.int64))
    prepared = PreparedPair(pair, (sides[0], sides[1]), nothing)
    assert len(rows) > 20
    assert pose_error_deg(prepared, np.stack([rows, rows], 1)) < 0.2
    shuffled = np.stack([rows, np.roll(rows, 7)], 1)
    assert pose_error_deg(prepared, shuffled) > 2
    assert pose_error_deg(prepared, np.zeros((0, 2), np.int64)) == np.inf
