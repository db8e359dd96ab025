"""Plugins that are networks with a checkpoint: their options, the file, the network made once."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from threading import Lock
from typing import Any, ClassVar, Generic, TypeVar

import torch

from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.runtime import pick_device
from megloc_kapture.values import Options

AnyOptions = TypeVar("AnyOptions", bound=Options)
_making = Lock()


class Checkpointed(Generic[AnyOptions]):
    """A plugin that is a network; the option ``weights`` names its file, a name or a path.

    Raises
    ------
    MissingWeightsError : a checkpoint is not there.
    """

    Options: ClassVar[Any]

    def __init__(self, options: AnyOptions | None = None) -> None:
        made: Any = options or self.Options()
        self.options: AnyOptions = made
        self._weights = find_weights(made.weights)
        other = getattr(made, "descriptor_weights", None)
        self._descriptor_weights: WeightsFile | None = other and find_weights(other)

    def weights(self) -> dict[str, str]:
        """sha256 of each checkpoint by its file's name."""
        files = [file for file in (self._weights, self._descriptor_weights) if file is not None]
        return {file.path.name: sha256_of(file) for file in files}

    def network(
        self,
        load: Callable[..., Any],
        *arguments: Any,
        file: WeightsFile | None = None,
        channels_last: bool = False,
    ) -> tuple[Any, torch.device]:
        """The network, made once per process, and the device it is on.

        Parameters
        ----------
        load : makes it of a checkpoint's tensors, the file's name, and the arguments.
        file : another checkpoint than the option's.
        channels_last : it is faster so on a processor.

        Raises
        ------
        DataError : the checkpoint does not fit.
        OptionError : the device is not there.
        """
        wanted: Any = self.options
        device = pick_device(wanted.device)
        with _making:  # threads that share it do not make one each
            return _made(load, file or self._weights, device, channels_last, *arguments), device


# a run may use as many
@lru_cache(maxsize=12)
def _made(load: Any, file: WeightsFile, device: Any, channels_last: bool, *arguments: Any) -> Any:
    network = load(read_weights(file), str(file.path), *arguments).eval().to(device)
    if channels_last and device.type == "cpu":
        network.to(memory_format=torch.channels_last)
    return network
