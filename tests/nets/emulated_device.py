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
PRODUCTS = {f"aten::{name}" for name in ("convolution", "mm", "bmm", "addmm", "baddbmm")}
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
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with torch._C.DisableTorchFunctionSubclass():
            return _GUARDED.get(func, func)(*args, **kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


# torch's own ask for the guard of a device, which builds for CPUs lack; so does indexing
_GUARDED: dict[Any, Any] = {
    torch.nonzero: lambda x, as_tuple=False: _nonzero(x, as_tuple),
    torch.Tensor.nonzero: lambda x, as_tuple=False: _nonzero(x, as_tuple),
    torch.Tensor.__invert__: torch.bitwise_not,
    torch.Tensor.__float__: lambda x: float(x.item()),
    torch.Tensor.__int__: lambda x: int(x.item()),
    torch.Tensor.__bool__: lambda x: bool(x.item()),
    torch.Tensor.contiguous: lambda x, memory_format=torch.contiguous_format: DeviceTensor(
        x.numbers.contiguous(memory_format=memory_format), x.device
    ),
}


def _nonzero(x: torch.Tensor, as_tuple: bool) -> Any:
    found = torch.ops.aten.nonzero(x)
    return found.unbind(1) if as_tuple else found


class _Mode(TorchDispatchMode):
    """Sends there what makes tensors on a device or copies tensors to it."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name, schema = func._schema.name, func._schema
    leaves = tree_leaves((args, kwargs))
    tensors = [leaf for leaf in leaves if isinstance(leaf, torch.Tensor)]
    devices = _devices(tensors)
    wanted = next((leaf for leaf in leaves if isinstance(leaf, torch.device)), None)
    if not devices and (wanted is None or wanted.type == "cpu"):
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
    where = wanted or next(iter(devices))
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
    if "pin_memory" in kwargs:
        kwargs = kwargs | {"pin_memory": False}
    if func._schema.name in SOFTMAX and args[2]:  # half to float, which only a GPU does in one
        args = (args[0].float(), args[1], False)
    halves = any(_float(leaf) is not leaf for leaf in tree_leaves((args, kwargs)))
    if halves and func._schema.name in PRODUCTS:  # with sums in float32, as GPUs do
        return tree_map(_half, func(*tree_map(_float, args), **tree_map(_float, kwargs)))
    return func(*args, **kwargs)


def _numbers(value: Any) -> Any:
    if isinstance(value, torch.device):
        return torch.device("cpu")
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
