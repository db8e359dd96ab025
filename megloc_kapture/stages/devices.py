"""Devices and batch sizes of networks.

On the CPU batches gain nothing and would change last bits.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from megloc_kapture.errors import MeglocError, PluginError

Item = TypeVar("Item")
Result = TypeVar("Result")

BATCH = 8  # for batch plugins without a device option
MOST_AT_ONCE = {"cpu": 1, "cuda": 16}


class DeviceMemoryError(MeglocError):
    """Out of memory for a single image or pair."""


def on_gpu(plugin: object) -> bool:
    return _device_of(plugin) not in (None, "cpu")


def most_at_once(plugin: object, many: str) -> int:
    """Return the batch size of a plugin; 1 without the batch method ``many``."""
    if not hasattr(plugin, many):
        return 1
    device = _device_of(plugin)
    return BATCH if device is None else MOST_AT_ONCE[device.partition(":")[0]]


def _device_of(plugin: object) -> str | None:
    """Return cpu, cuda or cuda:N; None if unspecified."""
    wanted = getattr(getattr(plugin, "options", None), "device", None)
    if wanted is None or wanted == "cpu":
        return wanted
    from megloc_kapture.nets.runtime import pick_device

    return str(pick_device(wanted))


_limits: dict[tuple[str, str, str], int] = {}  # batch sizes after running out of memory


def in_batches(
    plugin: object,
    many: str,
    run: Callable[[Sequence[Item]], Sequence[Result]],
    items: Sequence[Item],
    *,
    name: Callable[[int], str],
) -> list[Result]:
    """Run a plugin on items in batches, halved when memory runs out.

    Raise DeviceMemoryError if one item does not fit.
    """
    key = type(plugin).__qualname__, many, repr(getattr(plugin, "options", None))
    found: list[Result] = []
    while len(found) < len(items):
        most = min(most_at_once(plugin, many), _limits.get(key, sys.maxsize))
        batch = items[len(found) :][:most]
        try:
            results = run(batch)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            if len(batch) == 1:
                raise DeviceMemoryError(
                    f"{name(len(found))}: there is not enough memory for it alone; make images "
                    "smaller (max_megapixels, preprocessing.max_size_px), keep fewer keypoints, or "
                    "compute on another device (--device)"
                ) from error
            _limits[key] = len(batch) // 2
            continue
        if len(results) != len(batch):
            raise PluginError(f"{many} of {key[0]} gave {len(results)} for {len(batch)} items")
        found += results
    return found


# of plain RuntimeErrors: allocation by the CPU, by CUDA contexts, cuBLAS and cuDNN
_OUT_OF_MEMORY = (
    "can't allocate memory",
    "out of memory",
    "CUBLAS_STATUS_ALLOC_FAILED",
    "CUDNN_STATUS_ALLOC_FAILED",
    "CUDNN_STATUS_INTERNAL_ERROR_HOST_ALLOCATION_FAILED",
    "CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED",
)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether torch ran out of memory, on any device and in any library below it."""
    torch: Any = sys.modules.get("torch")
    if torch is None or not isinstance(error, RuntimeError):
        return False
    return isinstance(error, torch.OutOfMemoryError) or any(
        text in str(error) for text in _OUT_OF_MEMORY
    )
