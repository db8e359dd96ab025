"""Deformable convolution and ALIKED: ours against kornia's, interleaved, with their agreement.

    .venv/bin/python benchmarks/speed/deformable.py --image photograph.jpg --weights aliked-n16

Seconds are medians of several rounds in which each takes its turn, so that a busy machine slows
both. A convolution has 128 channels in and out, offsets of 2 pixels and amplitudes, as ASLFeat's.
ALIKED is compared from an image to its score map and 1500 descriptors: kornia's makes the features
of every pixel, ours those that it looks at.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import kornia.feature as KF
import numpy as np
import torch
from kornia.feature.aliked.deform_conv2d import deform_conv2d as kornia_deform_conv2d
from timing import table
from torch.nn import functional

from megloc_kapture.features.aliked import AlikedNet, aliked_from
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.runtime import image_tensor, inference
from megloc_kapture.nets.score_maps import deform_conv2d

CPU = torch.device("cpu")


def interleaved(runs: Sequence[Callable[[], object]], rounds: int) -> list[float]:
    """Median seconds of each, after one run that is not counted."""
    seconds: list[list[float]] = [[] for _ in runs]
    for turn in range(rounds + 1):
        for run, taken in zip(runs, seconds, strict=True):
            start = time.perf_counter()
            run()
            if turn:
                taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in seconds]


def convolutions(sizes: Sequence[tuple[int, int]], rounds: int) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        ("deformable, 128 channels", "plain s", "ours s", "kornia s", "kornia / ours", "difference")
    ]
    for height, width in sizes:
        generator = torch.Generator().manual_seed(0)
        x = torch.randn(1, 128, height, width, generator=generator)
        last = x.contiguous(memory_format=torch.channels_last)
        offset = 2 * torch.randn(1, 18, height, width, generator=generator)
        mask = torch.rand(1, 9, height, width, generator=generator)
        weight = torch.randn(128, 128, 3, 3, generator=generator) / 34  # outputs of about one
        plain = partial(functional.conv2d, last, weight, padding=1)
        ours = partial(deform_conv2d, last, offset, weight, None, mask)
        theirs = partial(kornia_deform_conv2d, x, offset, weight, None, 1, 1, 1, mask)
        with inference(CPU):
            difference = float((ours() - theirs()).abs().max())
            seconds = interleaved([plain, ours, theirs], rounds)
        rows.append(
            (
                f"{height}x{width}",
                *(f"{s:.3f}" for s in seconds),
                f"{seconds[2] / seconds[1]:.1f}",
                f"{difference:.1e}",
            )
        )
    return rows


def run_ours(net: AlikedNet, image: torch.Tensor, xy: torch.Tensor) -> list[torch.Tensor]:
    """Score map (H, W) and descriptors (N, D) at pixels xy (N, 2)."""
    maps = net(image)[0]
    return [maps.scores, net.desc_head(maps, xy)]


def run_kornias(net: KF.ALIKED, image: torch.Tensor, xy: torch.Tensor) -> list[torch.Tensor]:
    """The same of kornia's."""
    features, scores = net.extract_dense_map(image)
    last = torch.tensor([image.shape[3] - 1, image.shape[2] - 1])
    return [scores[0, 0], net.desc_head(features, [xy / last * 2 - 1])[0][0]]


def aliked(
    image: Path, weights: str, sizes: Sequence[tuple[int, int]], rounds: int
) -> list[tuple[str, ...]]:
    file = find_weights(weights)
    tensors = read_weights(file)
    ours = aliked_from(tensors, str(file.path))
    theirs = KF.ALIKED(file.path.stem)
    theirs.load_state_dict(tensors, strict=False)
    theirs.eval()
    rows: list[tuple[str, ...]] = [
        (file.path.stem, "ours s", "kornia s", "kornia / ours", "scores differ", "descriptors")
    ]
    pixels = read_image_rgb(image)
    for height, width in sizes:
        resized = np.asarray(cv2.resize(pixels, (width, height)), dtype=np.uint8)
        planes = image_tensor(resized, CPU)
        with inference(CPU):
            best = ours(planes).scores.reshape(-1).topk(1500).indices
            xy = torch.stack([best % width, best // width], dim=1) + 0.25
            runs = [partial(run_ours, ours, planes, xy), partial(run_kornias, theirs, planes, xy)]
            differences = [
                f"{float((a - b).abs().max()):.1e}"
                for a, b in zip(runs[0](), runs[1](), strict=True)
            ]
            seconds = interleaved(runs, rounds)
        rows.append(
            (
                f"{width}x{height}",
                *(f"{s:.3f}" for s in seconds),
                f"{seconds[1] / seconds[0]:.1f}",
                *differences,
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--image", type=Path, required=True, help="a photograph")
    parser.add_argument("--weights", default="aliked-n16", help="name in the registry, or a file")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"{options.threads} threads, median of {options.rounds}")
    print(table(convolutions([(60, 80), (120, 160), (200, 256)], options.rounds)))
    print()
    sizes = [(480, 640), (1200, 1600)]
    print(table(aliked(options.image, options.weights, sizes, options.rounds)))


if __name__ == "__main__":
    main()
