"""Devices, precision, inputs and checkpoints of networks, and the base of network plugins."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache, lru_cache
from pathlib import Path
from threading import Lock, RLock
from typing import Any, ClassVar, Generic, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.geometry.cameras import reduced_size
from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.plugin_loading import NetworkOptions as NetworkOptions
from megloc_kapture.values import Device, Options

_log = logging.getLogger(__name__)
_gpu_lock = RLock()
AnyOptions = TypeVar("AnyOptions", bound=Options)
Net = TypeVar("Net", bound=nn.Module)
_loading_lock = Lock()


@cache
def pick_device(device: Device) -> torch.device:
    """Return the torch device; OptionError if this machine lacks it."""
    count = torch.cuda.device_count() if device != "cpu" and torch.cuda.is_available() else 0
    if device == "cpu" or (device == "auto" and not count):
        return torch.device("cpu")
    if not count:
        raise OptionError(f"device={device}: this machine has no GPU that torch can use; use auto")
    if int(device.partition(":")[2] or 0) >= count:
        known = ", ".join(f"cuda:{number}" for number in range(count))
        raise OptionError(f"device={device}: this machine has no such GPU; known: {known}")
    return torch.device("cuda", int(device.partition(":")[2] or 0))


@contextmanager
def inference(device: torch.device, half_precision: bool = False) -> Iterator[None]:
    """Disable gradients and TF32; half precision is float16 on a GPU and bfloat16 on a CPU."""
    half = torch.float16 if device.type == "cuda" else torch.bfloat16
    autocast = torch.autocast(device.type, dtype=half, enabled=half_precision)
    if half_precision and device.type == "cpu":
        _warn_of_slow_half()
    # TF32 is a setting of the whole process, so only one thread at a time computes on the GPU
    exclusive = _gpu_lock if device.type == "cuda" else nullcontext()
    with exclusive, without_tf32(device), torch.inference_mode(), autocast:
        yield


@cache
def _warn_of_slow_half() -> None:
    if not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        _log.warning("this processor has no bfloat16: half precision is 100 times slower than full")


@contextmanager
def without_tf32(device: torch.device) -> Iterator[None]:
    """Compute float32 matrix products and convolutions in full precision, in all threads."""
    if device.type == "cpu":
        yield
        return
    products: Any = torch.backends.cuda.matmul
    convolutions: Any = torch.backends.cudnn
    name: str = "allow_tf32"
    exact: Any = False
    if hasattr(products, "fp32_precision"):  # torch 2.9 rejects a mix with the older settings
        convolutions, name, exact = convolutions.conv, "fp32_precision", "ieee"
    settings = products, convolutions
    previous = [getattr(setting, name) for setting in settings]
    for setting in settings:
        setattr(setting, name, exact)
    try:
        yield
    finally:
        for setting, value in zip(settings, previous, strict=True):
            setattr(setting, name, value)


def image_tensor(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """Convert an RGB image, uint8 (H, W, 3), to float32 (1, 3, H, W) in [0, 1]."""
    pixels = torch.from_numpy(np.array(image, order="C")).to(device)
    return pixels.permute(2, 0, 1)[None].contiguous().float() / 255.0


def in_fast_layout(batch: torch.Tensor) -> torch.Tensor:
    """Return images (N, C, H, W) in the layout of ``Checkpointed.network(channels_last=True)``."""
    on_cpu = batch.device.type == "cpu"
    return batch.contiguous(
        memory_format=torch.channels_last if on_cpu else torch.contiguous_format
    )


def sized_tensor(
    image: NDArray[np.uint8], max_size_px: int | None, device: torch.device
) -> torch.Tensor:
    """Convert an RGB image, uint8 (H, W, 3), to float32 (1, 3, h, w) in [0, 1], with a size limit.

    Larger images are reduced by area averaging without rounding of the values, as in hloc. Sides
    are rounded half to even, and are at least 1.
    """
    height, width = image.shape[:2]
    size = reduced_size(width, height, max_size_px)
    if size == (width, height):
        return image_tensor(image, device)
    resized = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.asarray(resized)).to(device).permute(2, 0, 1)[None] / 255.0


def batch_counters(module: nn.Module) -> set[str]:
    """Return the keys of batch counters, which weights from ONNX and torch before 0.4.1 lack."""
    return {key for key in module.state_dict() if key.endswith("num_batches_tracked")}


def load_strictly(
    module: Net, tensors: Mapping[str, torch.Tensor], where: str, *, may_lack: Collection[str] = ()
) -> Net:
    """Load a state dict with matching keys and shapes; only ``may_lack`` may be missing."""
    expected = module.state_dict()
    missing = sorted(set(expected) - set(tensors) - set(may_lack))
    unexpected = sorted(set(tensors) - set(expected))
    reshaped = [
        f"{key} is {tuple(tensors[key].shape)}, not {tuple(expected[key].shape)}"
        for key in sorted(set(expected) & set(tensors))
        if tensors[key].shape != expected[key].shape
    ]
    problems = [
        f"{len(keys)} {what}: {first_few(keys)}"
        for what, keys in (
            ("missing keys", missing),
            ("unexpected keys", unexpected),
            ("keys with a different shape", reshaped),
        )
        if keys
    ]
    if problems:
        raise DataError(
            f"this file does not fit {type(module).__name__}; {'; '.join(problems)}", path=where
        )
    if not any(getattr(tensor, "is_shared_file", False) for tensor in tensors.values()):
        module.load_state_dict(dict(tensors), strict=False)
        return module
    # keep memory-mapped tensors as parameters, so that all processes share them
    parameters = {
        key: value
        if getattr(value, "is_shared_file", False) and value.dtype == expected[key].dtype
        else torch.empty(value.shape, dtype=expected[key].dtype).copy_(value)
        for key, value in tensors.items()
    }
    module.load_state_dict(parameters, strict=False, assign=True)
    return module


def first_few(keys: Sequence[str], count: int = 5) -> str:
    more = len(keys) - count
    return ", ".join(keys[:count]) + (f" and {more} more" if more > 0 else "")


class Checkpointed(Generic[AnyOptions]):
    """Base of plugins with a network; the option ``weights`` is a registered name or a path."""

    Options: ClassVar[Any]

    def __init__(self, options: AnyOptions | None = None) -> None:
        made: Any = options or self.Options()
        self.options: AnyOptions = made
        self._weights = find_weights(made.weights)
        other = getattr(made, "descriptor_weights", None)
        self._descriptor_weights: WeightsFile | None = other and find_weights(other)

    def weights(self) -> dict[str, str]:
        files = [file for file in (self._weights, self._descriptor_weights) if file is not None]
        return {file.path.name: sha256_of(file) for file in files}

    def network(
        self,
        load: Callable[..., Any],
        *arguments: Any,
        file: WeightsFile | None = None,
        channels_last: bool = False,
    ) -> tuple[Any, torch.device]:
        """Return the network, loaded once per process, and its device.

        Parameters
        ----------
        load : builds the network from a checkpoint's tensors, its path and the arguments.
        file : replaces the checkpoint of the option ``weights``.
        channels_last : use this layout on a CPU, where it is faster; see :func:`in_fast_layout`.
        """
        wanted: Any = self.options
        device = pick_device(wanted.device)
        with _loading_lock:
            chosen = file or self._weights
            return _load_cached(load, chosen, device, channels_last, *arguments), device


@lru_cache(maxsize=12)
def _load_cached(
    load: Any, file: WeightsFile, device: Any, channels_last: bool, *arguments: Any
) -> Any:
    network = load(read_weights(file), str(file.path), *arguments).eval().to(device)
    if channels_last and device.type == "cpu":
        network.to(memory_format=torch.channels_last)
    return network


def state_bytes(
    model: torch.nn.Module, optimizer: torch.optim.Optimizer, more: Mapping[str, Any]
) -> bytes:
    """Serialise the state; ``more`` has numbers, strings and lists of them, including ``step``."""
    stream = io.BytesIO()
    content = {**more, "model": model.state_dict(), "optimizer": optimizer.state_dict()}
    torch.save(content, stream)
    return stream.getvalue()


def load_state(
    state: bytes, path: Path, model: torch.nn.Module, optimizer: torch.optim.Optimizer
) -> dict[str, Any]:
    try:
        content = torch.load(io.BytesIO(state), map_location="cpu", weights_only=True)
        model.load_state_dict(content.pop("model"))
        optimizer.load_state_dict(content.pop("optimizer"))
        return {**content, "step": int(content["step"])}
    except Exception as error:  # torch raises many kinds of errors on damaged files
        raise DataError(
            "is damaged or from another training run; -f starts over", path=path
        ) from error
