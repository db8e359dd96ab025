"""Writes reference.npz of this folder: outputs of DeepLabV3+ as its authors published it.

The network of github.com/VainF/DeepLabV3Plus-Pytorch, at output stride 16 with 19 classes, gets
random weights and an image; none of its code is kept here. It needs torch and numpy alone:

    git clone https://github.com/VainF/DeepLabV3Plus-Pytorch
    git -C DeepLabV3Plus-Pytorch checkout 48f990b258f52d5e8880380c7a00df29bce045d8
    python make_reference.py DeepLabV3Plus-Pytorch

For each of the two backbones there are the head's logits, float32 (19, h, w), at a quarter of the
image's size, and the class of the largest at the image's own size, uint8 (H, W).
"""

import sys
from pathlib import Path

import numpy as np
import torch

SIZE = 35, 331  # height, width: at a sixteenth 3 and 21, more than the largest dilation, 18
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def random_state(shapes):
    """Random values by key and shape that keep activations near 1, by any version of numpy."""
    state = {}
    for number, (key, shape) in enumerate(sorted(shapes.items())):
        if key.endswith("num_batches_tracked"):
            state[key] = torch.tensor(1)
            continue
        count = int(np.prod(shape))
        bits = np.random.PCG64(number).random_raw(-(-count // 4)).astype("<u8").view("<u2")[:count]
        values = torch.from_numpy(bits.astype(np.float32).reshape(shape)).div_(2**16)  # [0, 1)
        if len(shape) >= 4:
            values = values.sub_(0.5).mul_((24 / np.prod(shape[1:])) ** 0.5)
        elif key.endswith("running_var"):
            values = 0.5 + 1.5 * values
        elif key.endswith("running_mean"):
            values = 0.4 * values - 0.2
        elif key.endswith("weight"):
            values = 0.5 + 0.5 * values
        else:
            values = 0.6 * values - 0.3  # bias
        state[key] = values
    return state


def texture():
    """An RGB image of patches, uint8 (H, W, 3)."""
    bits = np.random.PCG64(0).random_raw((SIZE[0] // 8 + 1) * (SIZE[1] // 8 + 1) * 3)
    coarse = (bits >> 56).astype(np.uint8).reshape(SIZE[0] // 8 + 1, SIZE[1] // 8 + 1, 3)
    return coarse.repeat(8, axis=0).repeat(8, axis=1)[: SIZE[0], : SIZE[1]]


def main(clone):
    sys.path.insert(0, clone)
    from network.modeling import deeplabv3plus_mobilenet, deeplabv3plus_resnet101

    image = texture()
    x = torch.from_numpy(image.copy()).permute(2, 0, 1)[None].float() / 255
    x = (x - torch.tensor(MEAN)[:, None, None]) / torch.tensor(DEVIATION)[:, None, None]
    arrays = {"image": image}
    makers = {"resnet101": deeplabv3plus_resnet101, "mobilenet": deeplabv3plus_mobilenet}
    for backbone, make in makers.items():
        network = make(num_classes=19, output_stride=16, pretrained_backbone=False).eval()
        shapes = {key: tuple(value.shape) for key, value in network.state_dict().items()}
        network.load_state_dict(random_state(shapes), strict=True)
        with torch.inference_mode():
            logits = network.classifier(network.backbone(x))[0].numpy()
            classes = network(x)[0].argmax(dim=0).numpy().astype(np.uint8)
        print(backbone, logits.shape, logits.std(axis=(1, 2)).mean(), np.bincount(classes.ravel()))
        arrays[f"{backbone}/logits"], arrays[f"{backbone}/classes"] = logits, classes
    np.savez_compressed(Path(__file__).parent / "reference.npz", **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
