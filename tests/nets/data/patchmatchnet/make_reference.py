"""Writes reference.npz of this folder: depth by PatchmatchNet as its authors published it.

The network gets random weights, three images and their cameras; none of its code is kept here. It
needs torch and numpy alone:

    git clone https://github.com/FangjinhuaWang/PatchmatchNet
    git -C PatchmatchNet checkout c6299a9486e8cc2cd3040730ccf09173fe2a259f
    python make_reference.py PatchmatchNet

``images`` is uint8 (3, H, W, 3), the reference first; ``intrinsics`` (3, 3); ``rotations`` and
``translations`` of ``cam_from_world``, (3, 3, 3) and (3, 3); ``depth`` is float32 (H, W) and
``confidence`` float32 (H / 2, W / 2), which the network enlarges to the nearest pixels.
"""

import runpy
import sys
from pathlib import Path

import numpy as np
import torch

HERE = Path(__file__).parent
SIZE = 64, 88  # height, width
LIMITS = 2.0, 9.0
# the published setting of its eval.py
SETTING = ([0.005, 0.0125, 0.025], [6, 4, 2], [1, 2, 2], [8, 8, 16], [0, 8, 16], [9, 9, 9])
random_state = runpy.run_path(str(HERE.parent / "deeplabv3plus" / "make_reference.py"))[
    "random_state"
]


def weights(shapes):
    """A state dict with random values under which hypotheses differ clearly.

    Parameters
    ----------
    shapes : key -> shape.
    """
    state = random_state(shapes)
    for key, value in state.items():
        if key.endswith("similarity_net.similarity.weight"):
            value.mul_(1000)
    return state


def textures():
    """Images of patches, uint8 (3, H, W, 3)."""
    rows, columns = SIZE[0] // 4, SIZE[1] // 4
    bits = np.random.PCG64(0).random_raw(rows * columns * 3)
    one = (bits >> 56).astype(np.uint8).reshape(rows, columns, 3)
    one = one.repeat(4, axis=0).repeat(4, axis=1)
    return np.stack([one, np.roll(one, 6, axis=1), np.roll(one, -4, axis=1)])


def turned(angle_deg):
    """Rotation (3, 3) about the y axis."""
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def main(clone):
    sys.path.insert(0, clone)
    from models.net import PatchmatchNet

    network = PatchmatchNet(*SETTING).eval()
    shapes = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    network.load_state_dict(weights(shapes), strict=True)
    images = textures()
    intrinsics = np.array([[80.0, 0, 43.5], [0, 80.0, 31.5], [0, 0, 1]])
    rotations = np.stack([turned(angle) for angle in (1, 4, -2)])
    translations = np.array([[0.1, 0, 0], [-0.4, 0.02, 0.01], [0.5, -0.03, 0.02]])
    extrinsics = torch.eye(4).repeat(1, 3, 1, 1)
    extrinsics[0, :, :3, :3] = torch.from_numpy(rotations)
    extrinsics[0, :, :3, 3] = torch.from_numpy(translations)
    torch.manual_seed(0)  # of the first hypotheses
    with torch.inference_mode():
        depth, confidence, _ = network(
            [torch.from_numpy(one).permute(2, 0, 1)[None].float() / 255 for one in images],
            torch.from_numpy(intrinsics).float().repeat(1, 3, 1, 1),
            extrinsics,
            *(torch.tensor([limit]) for limit in LIMITS),
        )
    depth, confidence = depth[0, 0].numpy(), confidence[0, ::2, ::2].numpy()
    print(np.quantile(depth, [0, 0.1, 0.5, 0.9, 1]), confidence.min(), confidence.max())
    np.savez_compressed(
        HERE / "reference.npz",
        images=images,
        intrinsics=intrinsics,
        rotations=rotations,
        translations=translations,
        depth=depth,
        confidence=confidence,
    )


if __name__ == "__main__":
    main(sys.argv[1])
