"""One copy of a checkpoint's tensors for all processes of a machine.

The first process that reads a checkpoint writes its tensors into a folder of the run; it and the
others map that file into memory. What is mapped is the system's cache of the file, which is there
once, and is not counted against a process. Kept is what was read and checked, so that a file of the
user may change meanwhile.
"""

from __future__ import annotations

import fcntl
import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.errors import OutputError
from megloc_kapture.io.files import atomic_write

if TYPE_CHECKING:
    import torch

_folder: Path | None = None


def share_weights(folder: Path | None) -> None:
    """Let this process share what it reads with the others that are told the same folder."""
    global _folder
    _folder = folder


def shared_tensors(
    key: object, read: Callable[[], dict[str, torch.Tensor]]
) -> dict[str, torch.Tensor]:
    """Tensors by name, of a file that the first process wrote; without a folder what is read.

    Parameters
    ----------
    key : tells checkpoints apart; equal in all processes.
    """
    if _folder is None:
        return read()
    import torch

    path = _folder / f"weights-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}"
    found: dict[str, torch.Tensor] = {}
    try:
        with open(path.with_suffix(".lock"), "wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # the others wait for the first
            if not path.is_file():
                found = read()
                with atomic_write(path) as file:
                    torch.save({name: _whole(tensor) for name, tensor in found.items()}, file)
    except (OSError, OutputError, RuntimeError):  # torch's, too, where there is no room
        with suppress(OSError):
            path.unlink()
        return found or read()
    found = torch.load(path, mmap=True, weights_only=True)
    for tensor in found.values():  # ``load_strictly`` takes the memory as it is
        tensor.is_shared_file = True  # type: ignore[attr-defined]
    return found


def _whole(tensor: torch.Tensor) -> torch.Tensor:
    """Not a view, which would be written with all that it is a part of."""
    if tensor.is_contiguous() and tensor.untyped_storage().nbytes() == tensor.nbytes:
        return tensor
    return tensor.contiguous().clone()
