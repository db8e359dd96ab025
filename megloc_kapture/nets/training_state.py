"""How far a training is: networks, optimizer and the rest of it, as the bytes of a file."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from megloc_kapture.errors import DataError


def state_bytes(
    model: torch.nn.Module, optimizer: torch.optim.Optimizer, more: Mapping[str, Any]
) -> bytes:
    """The state as a file; ``more`` are numbers, texts and lists of them, among them ``step``."""
    stream = io.BytesIO()
    content = {**more, "model": model.state_dict(), "optimizer": optimizer.state_dict()}
    torch.save(content, stream)
    return stream.getvalue()


def load_state(
    state: bytes, path: Path, model: torch.nn.Module, optimizer: torch.optim.Optimizer
) -> dict[str, Any]:
    """Put a state into networks and optimizer; what else it has.

    Parameters
    ----------
    path : of the file, for the message.

    Raises
    ------
    DataError : the file is damaged, or of another training.
    """
    try:
        content = torch.load(io.BytesIO(state), map_location="cpu", weights_only=True)
        model.load_state_dict(content.pop("model"))
        optimizer.load_state_dict(content.pop("optimizer"))
        return {**content, "step": int(content["step"])}
    except Exception as error:  # torch raises many kinds on damaged files
        raise DataError(
            "not the state of this training, or damaged; -f begins again", path=path
        ) from error
