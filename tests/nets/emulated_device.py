"""CUDA devices emulated in Python: tensors that report ``cuda:N`` and compute on the CPU.

They raise where a GPU would (tensors of two devices in one operation, conversion to numpy), and
where it would wait (indices on the CPU into a tensor on the device). There are two devices and the
current one is the first, so that tests on ``cuda:1`` find a bare ``cuda``. No kernel of CUDA runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

COPIES = {"aten::copy_", "aten::_to_copy"}
SOFTMAX = {"aten::_softmax", "aten::_log_softmax"}
HALVES = (torch.float16, torch.bfloat16)


class DeviceTensor(torch.Tensor):
    """A tensor that says it is on a GPU; ``numbers`` are its values, on the CPU."""

    numbers: torch.Tensor

    @staticmethod
    def __new__(cls, real: torch.Tensor, device: torch.device) -> DeviceTensor:
        made: DeviceTensor = torch.Tensor._make_wrapper_subclass(
            cls, real.size(), strides=real.stride(), dtype=real.dtype, device=device
        )
        made.numbers = real
        return made

    def __repr__(self, **_: Any) -> str:
        return f"DeviceTensor({self.dtype}, {tuple(self.shape)}, {self.device})"

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError(f"can't convert {self.device} device type tensor to numpy")

    __array__ = numpy

    # torch's own indexing asks for the guard of a device that a build for CPUs has not
    def __getitem__(self, index: Any) -> Any:
        _check("indexing", self._tensors(self, index))
        return DeviceTensor(self.numbers[tree_map(_numbers, index)], self.device)

    def __setitem__(self, index: Any, value: Any) -> None:
        _check("indexing", self._tensors(self, index, value))
        self.numbers[tree_map(_numbers, index)] = _numbers(value)

    @staticmethod
    def _tensors(*indices: Any) -> list[torch.Tensor]:
        leaves = tree_leaves(indices)
        return [torch.as_tensor(x) for x in leaves if isinstance(x, torch.Tensor | np.ndarray)]

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Mode(TorchDispatchMode):
    """Sends there what makes tensors on a device or copies tensors to it."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name, schema = func._schema.name, func._schema
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    devices = _devices(tensors)
    wanted = kwargs.get("device")
    if not devices and (wanted is None or torch.device(wanted).type == "cpu"):
        return func(*args, **kwargs)
    if devices and name not in COPIES:
        _check(name, tensors)
    if name == "aten::copy_" and not isinstance(args[0], DeviceTensor):
        return args[0].copy_(_numbers(args[1]))
    result = _computed(func, tree_map(_numbers, args), tree_map(_numbers, kwargs))
    written = [
        args[at] if at < len(args) else kwargs[argument.name]
        for at, argument in enumerate(schema.arguments)
        if argument.alias_info is not None and argument.alias_info.is_write
    ]
    if written:
        return (written[0] if len(written) == 1 else tuple(written)) if schema.returns else None
    where = next(iter(devices)) if wanted is None else torch.device(wanted)
    if where.type == "cpu":
        return result
    where = torch.device("cuda", where.index or 0)
    return tree_map(lambda x: DeviceTensor(x, where) if isinstance(x, torch.Tensor) else x, result)


def _devices(tensors: list[torch.Tensor]) -> set[torch.device]:
    return {tensor.device for tensor in tensors if isinstance(tensor, DeviceTensor)}


def _check(name: str, tensors: list[torch.Tensor]) -> None:
    """Allow tensors of one device only, but for numbers on the CPU (no dimensions)."""
    others = [one for one in tensors if not isinstance(one, DeviceTensor) and one.dim()]
    found = sorted(map(str, _devices(tensors))) + ["cpu"] * bool(others)
    if len(found) > 1:
        raise RuntimeError(f"{name}: tensors on {' and '.join(found)}")


def _computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    if kwargs.get("device") is not None:
        kwargs = kwargs | {"device": torch.device("cpu"), "pin_memory": False}
    if func._schema.name in SOFTMAX and args[2]:  # half to float, which only a GPU does in one
        args = (args[0].float(), args[1], False)
    try:
        return func(*args, **kwargs)
    except RuntimeError as error:
        if "not implemented for 'Half'" not in str(error):
            raise
        return tree_map(_half, func(*tree_map(_float, args), **tree_map(_float, kwargs)))


def _numbers(value: Any) -> Any:
    return value.numbers if isinstance(value, DeviceTensor) else value


def _float(value: Any) -> Any:
    return value.float() if isinstance(value, torch.Tensor) and value.dtype in HALVES else value


def _half(value: Any) -> Any:
    return value.half() if isinstance(value, torch.Tensor) and value.is_floating_point() else value


def _attention(q: Any, k: Any, v: Any, attn_mask: Any = None, **_: Any) -> torch.Tensor:
    """Compute torch's attention, which chooses its kernel by device, from products."""
    if torch.is_autocast_enabled(q.device.type):
        half = torch.get_autocast_dtype(q.device.type)
        q, k, v = (value.to(half) for value in (q, k, v))
    scores = q @ k.mT * q.shape[-1] ** -0.5
    if attn_mask is not None:
        scores = scores.masked_fill(~attn_mask, -torch.inf)
    return torch.softmax(scores.float(), -1).to(v.dtype) @ v


_tensor = torch.tensor


def _made(data: Any, *, device: Any = None, **named: Any) -> torch.Tensor:
    return _tensor(data, **named).to(device or "cpu")


def _made_as(self: torch.Tensor, data: Any, *, dtype: Any = None, device: Any = None) -> Any:
    return _tensor(data, dtype=dtype or self.dtype).to(device or self.device)


@contextmanager
def emulated_devices() -> Iterator[None]:
    """Let torch have two GPUs; the test is skipped where torch's internals differ."""
    overwriting = torch.__future__.get_overwrite_module_params_on_conversion()
    caching = torch.is_autocast_cache_enabled()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "_lazy_init", lambda: None)
        patch.setattr(torch.cuda, "is_available", lambda: True)
        patch.setattr(torch.cuda, "device_count", lambda: 2)
        patch.setattr(torch.cuda, "current_device", lambda: 0)
        patch.setattr(torch.cuda.amp.common, "amp_definitely_not_available", lambda: False)
        patch.setattr(torch, "inference_mode", torch.no_grad)
        patch.setattr(torch, "tensor", _made)  # torch's own copy to the device in C++
        patch.setattr(torch.Tensor, "new_tensor", _made_as)
        patch.setattr(torch.nn.functional, "scaled_dot_product_attention", _attention)
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        torch.set_autocast_cache_enabled(False)  # it keeps gradients, whose edges need a real GPU
        try:
            with torch.no_grad(), _Mode():
                try:
                    assert torch.ones(2).to("cuda:1").sum().item() == 2.0
                except Exception as error:
                    pytest.skip(f"this torch cannot be emulated: {error}")
                yield
        finally:
            torch.set_autocast_cache_enabled(caching)
            torch.__future__.set_overwrite_module_params_on_conversion(overwriting)
