"""A trunk for LPIPS from Keras' file of SqueezeNet 1.1, under torchvision's names.

    .venv/bin/python benchmarks/squeezenet_trunk.py KERAS.h5 trunk.safetensors

The file is read with h5py. Its network takes BGR from 0 to 255 less a mean, torchvision's RGB from
0 to 1 normalised: the difference goes into the first convolution, which pads nothing, so that the
features are the same. They are compared before anything is written. Whether torchvision's own
weights are these is not known: what LPIPS says with them is ``lpips-like``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from retrieval_networks import SqueezeNet
from safetensors.torch import save_file

from megloc_kapture.nets.lpips import SqueezeNetFeatures
from megloc_kapture.nets.runtime import load_strictly

_BGR_MEAN = (103.939, 116.779, 123.68)  # of Keras' networks, for values from 0 to 255
# of torchvision, for RGB in [0, 1]
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# fire2 to fire9 by their numbers among torchvision's layers
_FIRES = dict(zip(range(2, 10), (3, 4, 6, 7, 9, 10, 11, 12), strict=True))
_PARTS = {"squeeze1x1": "squeeze", "expand1x1": "expand1x1", "expand3x3": "expand3x3"}
_SIDE_PX = 127  # rounding up or down in pooling is the same
_MAX_DIFFERENCE = 1e-4  # of features, relative to the largest


def converted(network: SqueezeNet) -> dict[str, torch.Tensor]:
    """The weights under torchvision's names, without ``features.``."""
    deviation, mean, bgr_mean = (torch.tensor(v) for v in (_DEVIATION, _MEAN, _BGR_MEAN))
    first = network.kernels["conv1"].flip(1)
    scale, shift = 255.0 * deviation, 255.0 * mean - bgr_mean.flip(0)
    state = {
        "0.weight": (first * scale[:, None, None]).contiguous(),
        "0.bias": network.biases["conv1"] + (first * shift[:, None, None]).sum((1, 2, 3)),
    }
    for fire, number in _FIRES.items():
        for theirs, ours in _PARTS.items():
            state[f"{number}.{ours}.weight"] = network.kernels[f"fire{fire}/{theirs}"]
            state[f"{number}.{ours}.bias"] = network.biases[f"fire{fire}/{theirs}"]
    return state


def difference(network: SqueezeNet, state: dict[str, torch.Tensor]) -> float:
    """Of the two networks' last features on noise, relative to the largest."""
    trunk = SqueezeNetFeatures()
    load_strictly(trunk, state, "the converted file")
    image = torch.rand(1, 3, _SIDE_PX, _SIDE_PX, generator=torch.Generator().manual_seed(0))
    shift, deviation = (image.new_tensor(v)[:, None, None] for v in (_MEAN, _DEVIATION))
    with torch.inference_mode():
        theirs, ours = network(image), trunk((image - shift) / deviation)
    return float((theirs - ours).abs().max() / theirs.abs().max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("keras", type=Path)
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    network = SqueezeNet(options.keras)
    state = converted(network)
    off = difference(network, state)
    if not off <= _MAX_DIFFERENCE:
        sys.exit(f"features differ by {off:.1e}: {options.keras} is of another network")
    save_file({f"features.{key}": value for key, value in state.items()}, options.output)
    print(f"{options.output}: features differ by {off:.1e} of the largest")


if __name__ == "__main__":
    main()
