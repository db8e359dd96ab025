"""CUDA devices emulated in Python: tensors that report ``cuda:N`` and compute on the CPU.

They raise where a GPU does (tensors of two devices, conversion to numpy) and where it waits
(indices on the CPU). The current device is the first of two, so that work on ``cuda:1`` finds a
bare ``cuda``. No kernel of CUDA runs.
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
PRODUCTS = {f"aten::{name}" for name in ("convolution", "mm", "bmm", "addmm", "baddbmm")}
CPU = torch.device("cpu")
_tensor = torch.tensor


class DeviceTensor(torch.Tensor):
    """A tensor that reports a GPU; ``numbers`` are its values on the CPU."""

    numbers: torch.Tensor

    @staticmethod
    def __new__(cls, numbers: torch.Tensor, device: torch.device) -> DeviceTensor:
        made: DeviceTensor = torch.Tensor._make_wrapper_subclass(
            cls, numbers.size(), strides=numbers.stride(), dtype=numbers.dtype, device=device
        )
        made.numbers = numbers
        return made

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError(f"can't convert {self.device} device type tensor to numpy")

    __array__ = numpy

    def __getitem__(self, index: Any) -> Any:
        _check("indexing", self, index)
        return DeviceTensor(self.numbers[tree_map(_on_cpu, index)], self.device)

    def __setitem__(self, index: Any, value: Any) -> None:
        _check("indexing", self, index, value)
        self.numbers[tree_map(_on_cpu, index)] = _on_cpu(value)

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with torch._C.DisableTorchFunctionSubclass():
            return _GUARDED.get(func, func)(*args, **kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


# torch's functions need a device guard, which CPU builds lack
_GUARDED: dict[Any, Any] = {
    torch.nonzero: lambda x, as_tuple=False: _nonzero(x, as_tuple),
    torch.Tensor.nonzero: lambda x, as_tuple=False: _nonzero(x, as_tuple),
    torch.Tensor.__invert__: torch.bitwise_not,
    torch.Tensor.__float__: lambda x: float(x.item()),
    torch.Tensor.__int__: lambda x: int(x.item()),
    torch.Tensor.__bool__: lambda x: bool(x.item()),
    torch.Tensor.contiguous: lambda x, **named: DeviceTensor(
        x.numbers.contiguous(**named), x.device
    ),
}


def _nonzero(x: torch.Tensor, as_tuple: bool) -> Any:
    actual = torch.ops.aten.nonzero(x)
    return actual.unbind(1) if as_tuple else actual


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name, leaves = func._schema.name, tree_leaves((args, kwargs))
    devices = [leaf.device for leaf in leaves if isinstance(leaf, DeviceTensor)]
    wanted = next((leaf for leaf in leaves if isinstance(leaf, torch.device)), None)
    if not devices and (wanted is None or wanted.type == "cpu"):
        return func(*args, **kwargs)
    if name not in COPIES:
        _check(name, args, kwargs)
    if name == "aten::copy_" and not isinstance(args[0], DeviceTensor):
        return args[0].copy_(_on_cpu(args[1]))
    result = _computed(func, tree_map(_on_cpu, args), tree_map(_on_cpu, kwargs))
    written = [
        args[at] if at < len(args) else kwargs[argument.name]
        for at, argument in enumerate(func._schema.arguments)
        if argument.alias_info is not None and argument.alias_info.is_write
    ]
    if written:
        return None if not func._schema.returns else written[0] if len(written) == 1 else written
    where = wanted or devices[0]
    if where.type == "cpu":
        return result
    where = torch.device("cuda", where.index or 0)
    return tree_map(lambda x: DeviceTensor(x, where) if isinstance(x, torch.Tensor) else x, result)


def _check(name: str, *values: Any) -> None:
    """Refuse tensors of several devices; scalars on the CPU are allowed."""
    leaves = tree_leaves(values)
    actual = {leaf.device for leaf in leaves if isinstance(leaf, DeviceTensor)}
    arrays = (leaf for leaf in leaves if isinstance(leaf, torch.Tensor | np.ndarray))
    if any(leaf.ndim for leaf in arrays if not isinstance(leaf, DeviceTensor)):
        actual.add(CPU)
    if len(actual) > 1:
        raise RuntimeError(f"{name}: tensors on {' and '.join(sorted(map(str, actual)))}")


def _computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    if "pin_memory" in kwargs:
        kwargs = kwargs | {"pin_memory": False}
    if func._schema.name in ("aten::_softmax", "aten::_log_softmax") and args[2]:
        return func(args[0].float(), args[1], False)  # CPUs cannot convert here
    halves = any(_float(leaf) is not leaf for leaf in tree_leaves((args, kwargs)))
    if halves and func._schema.name in PRODUCTS:  # with sums in float32, as GPUs do
        return func(*tree_map(_float, args), **tree_map(_float, kwargs)).half()
    return func(*args, **kwargs)


def _on_cpu(value: Any) -> Any:
    moved = CPU if isinstance(value, torch.device) else value
    return value.numbers if isinstance(value, DeviceTensor) else moved


def _float(value: Any) -> Any:
    half = isinstance(value, torch.Tensor) and value.dtype == torch.float16
    return value.float() if half else value


def _attention(q: Any, k: Any, v: Any, attn_mask: Any = None, **_: Any) -> torch.Tensor:
    if torch.is_autocast_enabled(q.device.type):
        q, k, v = (x.to(torch.get_autocast_dtype(q.device.type)) for x in (q, k, v))
    scores = q @ k.mT * q.shape[-1] ** -0.5
    scores = scores if attn_mask is None else scores.masked_fill(~attn_mask, -torch.inf)
    return torch.softmax(scores.float(), -1).to(v.dtype) @ v


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
        for name, value in {"is_available": True, "device_count": 2, "current_device": 0}.items():
            patch.setattr(torch.cuda, name, lambda value=value: value)
        patch.setattr(torch.cuda, "_lazy_init", lambda: None)
        patch.setattr(torch.cuda.amp.common, "amp_definitely_not_available", lambda: False)
        patch.setattr(torch, "inference_mode", torch.no_grad)
        patch.setattr(torch, "tensor", _made)
        patch.setattr(torch.Tensor, "new_tensor", _made_as)
        patch.setattr(torch.nn.functional, "scaled_dot_product_attention", _attention)
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        torch.set_autocast_cache_enabled(False)  # its gradients' edges need a real GPU
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
