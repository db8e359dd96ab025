"""Compare SuperPoint and SuperGlue with transformers' implementations on random weights.

    .venv/bin/python benchmarks/speed/superpoint_superglue.py

Both run alternately in one process, on the CPU, and their results are compared. Random weights take
as long as trained ones, except for a larger number of keypoint candidates.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from timing import table
from torch.nn import functional

from megloc_kapture.features.superpoint import SuperPointNet, sample_descriptors
from megloc_kapture.nets.runtime import inference
from megloc_kapture.nets.score_maps import pixel_scores, select_pixels, suppress_non_maxima
from megloc_kapture.nets.superglue import ImageKeypoints, SuperGlueNet, mutual_matches
from megloc_kapture.values import ImageFeatures

WIDTH, HEIGHT = 1600, 1200
THRESHOLD = 0.2
CPU = torch.device("cpu")

Weights = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Seconds:
    """Median times of a function. ``cpu`` (all threads) is unaffected by other load."""

    wall: float
    cpu: float


def time_alternately(functions: dict[str, Callable[[], Any]], repeat: int) -> dict[str, Seconds]:
    """Call the functions in turn, once to warm up and ``repeat`` times; return the medians."""
    wall: dict[str, list[float]] = {name: [] for name in functions}
    cpu: dict[str, list[float]] = {name: [] for name in functions}
    for turn in range(repeat + 1):
        for name, function in functions.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            function()
            if turn > 0:
                wall[name].append(time.perf_counter() - start)
                cpu[name].append(time.process_time() - cpu_start)
    return {n: Seconds(statistics.median(wall[n]), statistics.median(cpu[n])) for n in functions}


def superpoint_weights() -> Weights:
    torch.manual_seed(0)
    net = SuperPointNet()
    for name, value in net.named_parameters():
        if name.endswith("weight"):
            torch.nn.init.kaiming_normal_(value)  # keeps the magnitude of activations
    return net.state_dict()


def superglue_weights() -> Weights:
    """Return weights with peaked attention that match corresponding descriptors."""
    torch.manual_seed(0)
    weights = SuperGlueNet().state_dict()
    for key, value in weights.items():
        if value.ndim == 3:
            value.normal_(std=value.shape[1] ** -0.5)
        if ".proj.0." in key or ".proj.1." in key:
            value.mul_(12.0)
        elif ".mlp.3." in key:
            value.mul_(0.2)
    weights["final_proj.weight"] += 11.0 * torch.eye(256)[:, :, None]
    return weights


def random_pair(num: int) -> tuple[ImageFeatures, ImageFeatures]:
    """Return features of two images that share three quarters of their keypoints."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, [WIDTH, HEIGHT], (2, num, 2))
    descriptors = rng.standard_normal((2, num, 256))
    scores = rng.uniform(0.01, 0.9, (2, num))
    shared = num * 3 // 4
    xy[1, :shared] = np.clip(xy[0, :shared] + 20 * rng.standard_normal((shared, 2)), 0, HEIGHT)
    descriptors[1, :shared] = descriptors[0, :shared] + 0.7 * rng.standard_normal((shared, 256))
    descriptors /= np.linalg.norm(descriptors, axis=2, keepdims=True)
    a, b = (
        ImageFeatures(
            np.column_stack([xy[k], scores[k]]).astype(np.float32),
            descriptors[k].astype(np.float32),
            WIDTH,
            HEIGHT,
        )
        for k in (0, 1)
    )
    return a, b


def random_image() -> torch.Tensor:
    """Return gray noise at several scales, (1, 1, HEIGHT, WIDTH)."""
    generator = torch.Generator().manual_seed(0)
    image = torch.zeros(1, 1, HEIGHT, WIDTH)
    for side in (4, 16, 64):
        noise = torch.rand((1, 1, HEIGHT // side, WIDTH // side), generator=generator)
        image += functional.interpolate(noise, size=(HEIGHT, WIDTH), mode="bicubic") / 3
    return image.clamp(0, 1)


def their_superpoint(weights: Weights, num: int) -> Any:
    from transformers import SuperPointConfig, SuperPointForKeypointDetection

    # no border removal: transformers misplaces the right and the lower border
    config = SuperPointConfig(max_keypoints=num, border_removal_distance=0)
    model: Any = SuperPointForKeypointDetection(config)
    model.eval()
    # both have the same layers in the same order
    model.load_state_dict(dict(zip(model.state_dict(), weights.values(), strict=True)))
    return model


def superpoint_rows(num: int, repeat: int) -> list[tuple[str, ...]]:
    weights = superpoint_weights()
    theirs = their_superpoint(weights, num)
    ours = SuperPointNet().eval()
    ours.load_state_dict(weights)
    ours.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    gray = random_image()

    def their_dense() -> tuple[torch.Tensor, torch.Tensor]:
        features = theirs.encoder(gray)[0]
        points, described = theirs.keypoint_decoder, theirs.descriptor_decoder
        logits = points.conv_score_b(points.relu(points.conv_score_a(features)))
        maps = described.conv_descriptor_b(described.relu(described.conv_descriptor_a(features)))
        return pixel_scores(logits), functional.normalize(maps, dim=1)

    def keypoints(
        dense: tuple[torch.Tensor, torch.Tensor],
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        pixels, values = select_pixels(suppress_non_maxima(dense[0][0], 4), threshold=0.005)
        scores, best = values.topk(min(num, len(values)))
        return pixels[best], scores, sample_descriptors(dense[1][0], pixels[best], "official")

    with inference(CPU):
        seconds = time_alternately(
            {
                "theirs dense": their_dense,
                "ours dense": lambda: ours(gray),
                "theirs with our post-processing": lambda: keypoints(their_dense()),
                "theirs": lambda: theirs(gray.expand(1, 3, -1, -1)),
                "ours": lambda: keypoints(ours(gray)),
            },
            repeat,
        )
        dense = [(a - b).abs().max() for a, b in zip(their_dense(), ours(gray), strict=True)]
        xy, scores, descriptors = keypoints(ours(gray))
        expected = theirs(gray.expand(1, 3, -1, -1))
    their_xy = (expected.keypoints[0] * torch.tensor([WIDTH, HEIGHT])).round().long()
    same = _jaccard(xy.tolist(), their_xy.tolist())
    ranked = (xy == their_xy).all(dim=1)  # the order differs where scores differ in the last bits
    worst = (descriptors - expected.descriptors[0])[ranked].abs().max()
    dense_text = f"scores differ by {dense[0]:.0e}, descriptors by {dense[1]:.0e}"
    sparse_text = f"{len(xy)} keypoints, Jaccard {same:.4f}, descriptors differ by {worst:.0e}"
    compared = (
        ("dense", "theirs dense", "ours dense", dense_text),
        ("our post-processing in both", "theirs with our post-processing", "ours", ""),
        ("complete", "theirs", "ours", sparse_text),
    )
    return [
        _row(f"SuperPoint, {label}", seconds[a], seconds[b], text) for label, a, b, text in compared
    ]


def _row(label: str, theirs: Seconds, ours: Seconds, text: str) -> tuple[str, ...]:
    return (
        label,
        f"{theirs.wall:.2f}",
        f"{ours.wall:.2f}",
        f"{ours.wall / theirs.wall:.2f}",
        f"{theirs.cpu:.2f}",
        f"{ours.cpu:.2f}",
        f"{ours.cpu / theirs.cpu:.2f}",
        text,
    )


def their_superglue(weights: Weights) -> Any:
    from transformers import SuperGlueConfig, SuperGlueForKeypointMatching

    by_head = torch.arange(256).view(64, 4).T.flatten()  # their channels are grouped by head
    names = {
        "attn.proj.0": "attention.self.query",
        "attn.proj.1": "attention.self.key",
        "attn.proj.2": "attention.self.value",
        "attn.merge": "attention.output.dense",
        "mlp.0": "mlp.0.linear",
        "mlp.1": "mlp.0.batch_norm",
        "mlp.3": "mlp.1",
        "final_proj": "final_projection.final_proj",
        "kenc.encoder.12": "keypoint_encoder.encoder.4",
    }
    for layer in range(4):
        names[f"kenc.encoder.{3 * layer}"] = f"keypoint_encoder.encoder.{layer}.linear"
        names[f"kenc.encoder.{3 * layer + 1}"] = f"keypoint_encoder.encoder.{layer}.batch_norm"
    renamed = {}
    for key, value in weights.items():
        value = value[:, :, 0] if value.ndim == 3 else value
        if ".attn.proj." in key:
            value = value[by_head]
        elif key.endswith("merge.weight"):
            value = value[:, by_head]
        name = f".{key}"
        for ours, theirs in names.items():
            name = name.replace(f".{ours}.", f".{theirs}.")
        renamed[name[1:]] = value
    config: Any = SuperGlueConfig
    model: Any = SuperGlueForKeypointMatching(
        config(matching_threshold=THRESHOLD, attn_implementation="eager")
    )
    model.eval()
    keys = model.load_state_dict(renamed, strict=False)
    assert not keys.unexpected_keys
    assert all(key.startswith("keypoint_detector.") for key in keys.missing_keys)
    return model


def superglue_row(num: int, repeat: int) -> tuple[str, ...]:
    weights = superglue_weights()
    theirs = their_superglue(weights)
    ours = SuperGlueNet().eval()
    ours.load_state_dict(weights)
    pair = random_pair(num)
    tables = torch.stack([torch.from_numpy(side.keypoints_px) for side in pair])
    described = torch.stack([torch.from_numpy(side.descriptors) for side in pair])
    center = torch.tensor([WIDTH, HEIGHT]) / 2
    normalized = (tables[:, :, :2] - center) / (0.7 * WIDTH)
    a, b = (ImageKeypoints(normalized[k], tables[k, :, 2], described[k]) for k in (0, 1))

    def match() -> tuple[torch.Tensor, torch.Tensor]:
        return mutual_matches(ours([(a, b)], 100)[0], THRESHOLD)

    def their_match() -> Any:
        return theirs._match_image_pair(
            tables[None, :, :, :2], described[None], tables[None, :, :, 2], HEIGHT, WIDTH
        )

    with inference(CPU):
        seconds = time_alternately({"theirs": their_match, "ours": match}, repeat)
        matches, scores = match()
        partner, their_scores, _, _ = their_match()
    rows = torch.nonzero(partner[0, 0] >= 0)[:, 0]
    expected = torch.stack([rows, partner[0, 0, rows]], dim=1)
    same = _jaccard(matches.tolist(), expected.tolist())
    worst = (scores - their_scores[0, 0, matches[:, 0]]).abs().max()
    text = f"{len(matches)} matches, Jaccard {same:.4f}, scores differ by {worst:.0e}"
    return _row(f"SuperGlue, {num} keypoints", seconds["theirs"], seconds["ours"], text)


def _jaccard(a: list[list[int]], b: list[list[int]]) -> float:
    first, second = set(map(tuple, a)), set(map(tuple, b))
    return len(first & second) / max(len(first | second), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keypoints", type=int, default=1500)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    os.environ["HF_HUB_OFFLINE"] = "1"
    torch.set_num_threads(options.threads)
    load = os.getloadavg()[0]
    rows: list[tuple[str, ...]] = [
        ("seconds", "transformers", "ours", "ratio", "cpu", "ours", "ratio", "agreement")
    ]
    rows += superpoint_rows(options.keypoints, options.repeat)
    rows.append(superglue_row(options.keypoints, options.repeat))
    print(f"{WIDTH}x{HEIGHT}, {options.threads} threads, {options.repeat} repetitions")
    print(table(rows))
    print(f"load average {load:.1f} before, {os.getloadavg()[0]:.1f} after")


if __name__ == "__main__":
    main()
