"""Where and in which precision networks run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import OptionError
from megloc_kapture.values import Options

Device = Literal["auto", "cpu", "cuda"]


class NetworkOptions(Options):
    """Options that every network has."""

    device: Device = Field(default="auto", description="auto: a GPU where there is one")
    half_precision: bool = Field(
        default=False, description="float16 on a GPU, bfloat16 on a processor; keypoints never"
    )


def pick_device(device: Device) -> torch.device:
    """The device that is meant; raises OptionError where a GPU is asked for and there is none."""
    if device == "cpu":
        return torch.device("cpu")
    if torch.cuda.is_available():
        return torch.device("cuda")
    if device == "cuda":
        raise OptionError("device=cuda: this machine has no GPU that torch can use; take auto")
    return torch.device("cpu")


@contextmanager
def inference(device: torch.device, half_precision: bool = False) -> Iterator[None]:
    """No gradients; in half precision float16 on a GPU and bfloat16 on a processor.

    float32 stays float32 on a GPU: convolutions and products in TF32 would move keypoints.
    """
    half = torch.float16 if device.type == "cuda" else torch.bfloat16
    convolutions = torch.backends.cudnn.allow_tf32
    products = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    try:
        with (
            torch.inference_mode(),
            torch.autocast(device.type, dtype=half, enabled=half_precision),
        ):
            yield
    finally:
        torch.backends.cudnn.allow_tf32 = convolutions
        torch.backends.cuda.matmul.allow_tf32 = products


def image_tensor(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """An RGB image, uint8 (H, W, 3), as float32 (1, 3, H, W) in [0, 1]."""
    planes = torch.from_numpy(np.array(image.transpose(2, 0, 1), order="C"))
    return planes.to(device)[None].float() / 255.0
