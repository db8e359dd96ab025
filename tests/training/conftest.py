"""A rendered kapture with depth, and random weights of 64 dimensions."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from corner import pose_at, render, write_kapture
from kornia.feature import XFeat
from safetensors.torch import save_file
from torch import nn

from megloc_kapture.features.superpoint import SuperPointNet
from megloc_kapture.io.images import write_image

POSES = {f"{k}.png": pose_at((-2.4 + 0.8 * k, 0, 0), 24.0 - 12.0 * k, 0) for k in range(5)}


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five images of two walls, with poses and depth."""
    root = tmp_path_factory.mktemp("walk")
    write_kapture(root, POSES, with_poses=True, with_depth=True)
    return root


@pytest.fixture(scope="session")
def other_walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The last three of them, as another scene."""
    root = tmp_path_factory.mktemp("other_walk")
    write_kapture(root, dict(list(POSES.items())[2:]), with_poses=True, with_depth=True)
    return root


@pytest.fixture(scope="session")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("photographs")
    write_image(root / "wall.jpg", render(POSES["2.png"]))
    return root


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("weights")
    return {
        "superpoint": _random_file(folder / "superpoint_v1.safetensors", SuperPointNet(), 0),
        "xfeat": _random_file(folder / "xfeat.safetensors", XFeat().net, 1),
    }


def _random_file(path: Path, net: nn.Module, seed: int) -> str:
    torch.manual_seed(seed)
    for name, value in net.named_parameters():
        if name.endswith("weight"):
            nn.init.kaiming_normal_(value)
    save_file({key: value.contiguous() for key, value in net.state_dict().items()}, path)
    return str(path)
