"""Checkpoints into modules; one that does not fit is refused by the names of its keys."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from torch import nn

from megloc_kapture.errors import DataError

_NAMED = 5  # keys of each kind that a message names


def load_strictly(
    module: nn.Module,
    tensors: Mapping[str, torch.Tensor],
    where: str,
    *,
    may_lack: Collection[str] = (),
) -> None:
    """Load a state dict into a module, every key and shape as the module has it.

    Parameters
    ----------
    where : the file, for messages.
    may_lack : keys of the module that the file need not have.

    Raises
    ------
    DataError : names keys that are missing, unexpected, or of another shape.
    """
    expected = module.state_dict()
    missing = sorted(set(expected) - set(tensors) - set(may_lack))
    unexpected = sorted(set(tensors) - set(expected))
    reshaped = [
        f"{key} is {tuple(tensors[key].shape)}, not {tuple(expected[key].shape)}"
        for key in sorted(set(expected) & set(tensors))
        if tensors[key].shape != expected[key].shape
    ]
    wrong = [
        f"{len(keys)} {what}: {_some(keys)}"
        for what, keys in (
            ("missing keys", missing),
            ("unexpected keys", unexpected),
            ("keys of another shape", reshaped),
        )
        if keys
    ]
    if wrong:
        raise DataError(
            f"this file does not fit {type(module).__name__}; {'; '.join(wrong)}", path=where
        )
    module.load_state_dict(dict(tensors), strict=False)


def _some(keys: Sequence[str]) -> str:
    more = len(keys) - _NAMED
    return ", ".join(keys[:_NAMED]) + (f" and {more} more" if more > 0 else "")
