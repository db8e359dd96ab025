"""A photograph, and random weights of local features."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from convert_weights import aslfeat_state
from images import Image
from published import random_tensors
from safetensors.torch import save_file
from torch import nn

from megloc_kapture.features.superpoint import SuperPointNet
from megloc_kapture.io.images import read_image_rgb


@pytest.fixture(scope="session")
def superpoint_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    net = SuperPointNet()
    for name, value in net.named_parameters():
        if name.endswith("weight"):
            nn.init.kaiming_normal_(value)
    path = tmp_path_factory.mktemp("superpoint") / "superpoint_v1.pth"
    torch.save(net.state_dict(), path)
    return path


@pytest.fixture(scope="session")
def aslfeat_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights that respond to texture, converted from TensorFlow's layout."""
    arrays = {}
    for name, values in random_tensors("aslfeat").items():
        values = torch.randn(values.shape, generator=torch.Generator().manual_seed(len(arrays)))
        if name.startswith("deform_param"):
            values = values * 0.02
        elif name.endswith("kernel"):
            values = values * (2 / (9 * values.shape[2])) ** 0.5
        elif name.endswith("moving_mean"):
            values = values * 0.1
        else:
            values = values.abs() * 0.5 + (0.5 if values.ndim else 2)
        arrays[name] = values.numpy()
    path = tmp_path_factory.mktemp("aslfeat") / "aslfeat.safetensors"
    save_file(aslfeat_state(arrays), path)
    return path


@pytest.fixture(scope="session")
def photograph(shared_data: Path) -> Image:
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    return read_image_rgb(folder / "0003.jpg")
