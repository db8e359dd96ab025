"""Where networks compute, and how many items they get at once.

The option ``device`` of a plugin says where. On a processor it gets one item at a time: a batch
gains nothing there, and would change last bits. On a GPU it gets as many as there is memory for:
the first item runs alone, and what it took at most says how many others fit. Where memory runs out
all the same, the batch is halved.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from megloc_kapture.errors import MeglocError, PluginError
from megloc_kapture.plugin_loading import option_models
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.values import Device, Options

Item = TypeVar("Item")
Result = TypeVar("Result")
Value = TypeVar("Value")
Precision = Literal["full", "half"]

BATCH = 8  # items of a plugin that takes several and does not say where it computes
MOST_AT_ONCE = {"cpu": 1, "cuda": 16}
_SHARE = 0.8  # of the memory that is free


class DeviceMemoryError(MeglocError):
    """There is no memory for a single image or pair; names it."""


def on_gpu(plugin: object) -> bool:
    """Whether a plugin computes on a GPU."""
    return _device_of(plugin) not in (None, "cpu")


def most_at_once(plugin: object, many: str) -> int:
    """How many items a plugin gets at once, where there is memory for them.

    ``many``: name of the method that takes several items; a plugin without it gets one.
    """
    if not hasattr(plugin, many):
        return 1
    device = _device_of(plugin)
    return BATCH if device is None else MOST_AT_ONCE[device.partition(":")[0]]


def _device_of(plugin: object) -> str | None:
    """cpu, cuda or cuda:N; None where the plugin does not say."""
    wanted = getattr(getattr(plugin, "options", None), "device", None)
    if wanted is None or wanted == "cpu":
        return wanted
    from megloc_kapture.nets.runtime import pick_device

    return str(pick_device(wanted))


# ------------------------------------------------------------------------------------ batches


@dataclass
class _Limit:
    """What is known of a plugin's batches in this process."""

    items: int = sys.maxsize  # fewer once memory has run out
    bytes_per_unit: float | None = None  # of an item's size; None: not measured


_limits: dict[tuple[str, str, str], _Limit] = {}


def fitting(sizes: Sequence[float], bytes_per_unit: float, free_bytes: int) -> int:
    """How many of the next items go together, at least 1."""
    each = max(bytes_per_unit * max(sizes), 1.0)
    return max(1, min(len(sizes), int(_SHARE * free_bytes / each)))


def in_batches(
    plugin: object,
    many: str,
    run: Callable[[Sequence[Item]], Sequence[Result]],
    items: Sequence[Item],
    *,
    size: Callable[[Item], float],
    name: Callable[[int], str],
) -> list[Result]:
    """Results of items, as many of them at once as the plugin's device has memory for.

    Parameters
    ----------
    many : the plugin's method that takes several.
    run : of one item or several.
    size : memory grows with it.

    Raises
    ------
    DeviceMemoryError : there is no memory for one item.
    """
    most, device = most_at_once(plugin, many), _device_of(plugin) or "cpu"
    key = type(plugin).__qualname__, many, repr(getattr(plugin, "options", None))
    limit = _limits.setdefault(key, _Limit())
    cuda: Any = None if device == "cpu" else sys.modules["torch"].cuda
    found: list[Result] = []
    while len(found) < len(items):
        batch = items[len(found) :][: min(most, limit.items)]
        if cuda is not None and limit.bytes_per_unit is None:
            batch = batch[:1]
            cuda.reset_peak_memory_stats(device)
        elif cuda is not None and limit.bytes_per_unit is not None:
            kept = cuda.memory_reserved(device) - cuda.memory_allocated(device)
            free_bytes = cuda.mem_get_info(device)[0] + kept
            sizes = [size(item) for item in batch]
            batch = batch[: fitting(sizes, limit.bytes_per_unit, free_bytes)]
        try:
            results = run(batch)
        except RuntimeError as error:
            if not _is_out_of_memory(error):
                raise
            if len(batch) == 1:
                raise DeviceMemoryError(
                    f"{name(len(found))}: there is not enough memory for it alone; make images "
                    "smaller (max_megapixels, preprocessing.max_size_px), keep fewer keypoints, or "
                    "compute on another device (--device)"
                ) from error
            limit.items = len(batch) // 2
            continue
        if len(results) != len(batch):
            raise PluginError(f"{many} of {key[0]} gave {len(results)} for {len(batch)} items")
        if cuda is not None and limit.bytes_per_unit is None:  # beside what stays, as weights do
            used = cuda.max_memory_allocated(device) - cuda.memory_allocated(device)
            limit.bytes_per_unit = used / max(size(batch[0]), 1.0)
        found += results
    return found


def _is_out_of_memory(error: RuntimeError) -> bool:
    torch: Any = sys.modules.get("torch")
    # of a processor torch raises a plain error
    return torch is not None and (
        isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)
    )


# ------------------------------------------------------------------------------------ options


def placed(value: Value, device: Device, precision: Precision) -> Value:
    """Options whose plugins compute on a device; those that say so themselves stay.

    ``value``: options, or a tuple of them; the same object where there is nothing to say.
    """
    given: Any = value
    wanted = _wanted(device, precision)
    if wanted and isinstance(given, tuple):
        given = tuple(placed(one, device, precision) for one in given)
    elif wanted and isinstance(given, Options):
        tree = given.model_dump()
        given = type(given).model_validate(tree) if _tell(tree, wanted) & wanted.keys() else given
    return given


def unheeded(chosen: object, device: Device, precision: Precision) -> list[str]:
    """Of device and precision those that are set, and that no plugin has which options choose.

    ``chosen``: options, or a tuple of them.
    """
    lacking = _wanted(device, precision).keys() - _tell(chosen, {})
    return [name.replace("half_precision", "precision") for name in sorted(lacking)]


def _wanted(device: Device, precision: Precision) -> dict[str, Any]:
    """Options of networks."""
    wanted: dict[str, Any] = {"device": device} if device != "auto" else {}
    return wanted | ({"half_precision": True} if precision != "full" else {})


def _tell(tree: Any, wanted: dict[str, Any]) -> set[str]:
    """Set options of all plugins in nested tables that have them; which of both some have."""
    if isinstance(tree, Options):
        tree = tree.model_dump()
    if isinstance(tree, list | tuple):
        return set().union(*(_tell(one, wanted) for one in tree))
    if not isinstance(tree, dict):
        return set()
    options: Any = tree.get("options")
    found = _tell([one for one in tree.values() if one is not options], wanted)
    for model in option_models(tree["name"]) if isinstance(options, dict) else ():
        fields = model.model_fields
        for name in wanted.keys() & fields.keys():
            options.setdefault(name, wanted[name])
        for name, field in fields.items():
            if field.annotation is PluginChoice:
                choice = PluginChoice.model_validate(options.get(name, field.default)).model_dump()
                if taken := _tell(choice, wanted):
                    options[name], found = choice, found | taken
        found |= fields.keys() & {"device", "half_precision"}
    return found
