"""Loading of plugins by name, their options, and the fingerprint of their code."""

from __future__ import annotations

import hashlib
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError

from megloc_kapture.errors import MeglocError, PluginError, missing_extra, suggestion
from megloc_kapture.plugin_names import entry_points
from megloc_kapture.plugin_names import plugin_names as plugin_names
from megloc_kapture.plugins import PROTOCOLS, PluginChoice
from megloc_kapture.values import Device, Options

if TYPE_CHECKING:
    from numpy.typing import NDArray


class NetworkOptions(Options):
    """Device and precision of networks: options of a plugin, or part of a run's context.

    The run's values apply to networks whose own options do not set them.
    """

    device: Device = Field(default="auto", description="auto, cpu, cuda or cuda:N")
    half_precision: bool = Field(
        default=False,
        description="compute in float16 on a GPU, bfloat16 on a CPU, except for keypoint positions",
    )


AUTO = NetworkOptions()


def load_chosen(group: str, chosen: PluginChoice, placement: NetworkOptions = AUTO) -> Any:
    return load_plugin(group, chosen.name, chosen.options, placement)


def load_plugin(
    group: str, name: str, options: dict[str, Any] | None = None, placement: NetworkOptions = AUTO
) -> Any:
    """Create the plugin ``name`` of ``group``; MeglocError if it or its weights are unusable."""
    kind = plugin_class(group, name)
    model: Any = getattr(kind, "Options", None)
    given, wanted = options or {}, placement.model_dump(exclude_defaults=True)
    if model is not None:
        known = {key: value for key, value in wanted.items() if key in model.model_fields}
        given = {**known, **given}
    elif given:
        fault = f"it takes no options, got {', '.join(sorted(given))}"
        raise PluginError(f"plugin {name!r} rejects its options: {fault}")
    try:
        return kind() if model is None else kind(model(**given))
    except MeglocError:
        raise
    except ValidationError as error:
        fault = option_fault(error, model)
        raise PluginError(f"plugin {name!r} rejects its options: {fault}") from error
    except Exception as error:  # a third-party constructor may raise anything
        reason = " ".join(str(error).split())
        raise PluginError(f"plugin {name!r} cannot be created: {reason}") from error


def checked_array(
    who: str, array: Any, shape: tuple[int | None, ...], *dtypes: str
) -> NDArray[Any]:
    """Return a plugin's array if it has the shape, one of the types and finite values.

    ``who`` names plugin and image in the error; None in ``shape`` means any length.
    """
    import numpy as np

    if not isinstance(array, np.ndarray):
        actual = type(array).__name__
    else:
        lengths = zip(array.shape, shape, strict=False)
        fits = array.ndim == len(shape) and all(b in (None, a) for a, b in lengths)
        if fits and array.dtype.name in dtypes:
            if not np.isfinite(array).all():
                raise PluginError(f"{who}: some values are not finite")
            return array
        actual = f"{array.dtype} {array.shape}"
    free = iter("ND")
    wanted = ", ".join(next(free) if length is None else str(length) for length in shape)
    raise PluginError(f"{who}: got {actual}, expected {' or '.join(dtypes)} ({wanted})")


def option_fault(error: ValidationError, model: type[Options]) -> str:
    """Describe the invalid option; for an unknown one, suggest similar names."""
    first = error.errors()[0]
    option = ".".join(map(str, first["loc"]))
    if first["type"] == "extra_forbidden":
        return f"unknown option {option!r}; {suggestion(option, sorted(model.model_fields))}"
    message = first["msg"].removeprefix("Value error, ").replace("Input should", "it should")
    return f"{option}: {message}" if option else message


def plugin_class(group: str, name: str) -> Any:
    """Return the class registered as ``name`` in ``group``; PluginError if it cannot be loaded."""
    if not isinstance(name, str):
        raise PluginError(f"a plugin must be given by its registered name, got {name!r}")
    entries = [entry for entry in entry_points(group=group) if entry.name == name]
    if not entries:
        known = suggestion(name, plugin_names(group), listed="registered: ")
        raise PluginError(f"no plugin {name!r} in {group}; {known}")
    origins = {entry.value for entry in entries}
    if len(origins) > 1:
        raise PluginError(f"plugin {name!r} of {group} is registered twice: {sorted(origins)}")
    try:
        kind = entries[0].load()
    except Exception as error:  # importing a third-party module may raise anything
        reason = missing_extra(error) or error
        raise PluginError(
            f"plugin {name!r} ({entries[0].value}) cannot be loaded: {reason}"
        ) from error
    protocol = PROTOCOLS[group]
    missing = [member for member in _members(protocol) if not hasattr(kind, member)]
    if not isinstance(kind, type) or missing:
        what = "is not a class" if not isinstance(kind, type) else f"lacks {', '.join(missing)}"
        raise PluginError(
            f"plugin {name!r} ({entries[0].value}) does not implement {protocol.__name__}: "
            f"it {what}"
        )
    model: Any = getattr(kind, "Options", Options)
    if not isinstance(model, type) or not issubclass(model, Options):
        base = f"{Options.__module__}.{Options.__name__}"
        raise PluginError(f"plugin {name!r}: its Options are not derived from {base}")
    return kind


@cache
def code_of(kind: type) -> str:
    """Return package version and code hash of a class.

    The hash covers the module of the class; for a third-party class, all modules of its package.
    """
    module = sys.modules.get(kind.__module__)
    source = getattr(module, "__file__", None)
    files = [] if source is None else [Path(source)]
    top = getattr(sys.modules.get(kind.__module__.partition(".")[0]), "__file__", None) or ""
    if files and not is_ours(kind) and Path(top).name == "__init__.py":
        files = sorted({*files, *Path(top).parent.rglob("*.py")})
    digest = hashlib.sha256()
    for file in files:
        with suppress(OSError):
            digest.update(file.read_bytes())
    value = f"{kind.__module__}:{kind.__qualname__}"
    registered = [entry.dist for entry in entry_points(value=value) if entry.dist]
    return f"{registered[0].version if registered else ''} {digest.hexdigest()}".strip()


def is_ours(kind: type) -> bool:
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


def has_precision(plugin: object) -> bool:
    """Return whether a plugin has the option ``half_precision``, as plugins with networks do."""
    return hasattr(getattr(plugin, "options", None), "half_precision")


def weights_of(plugin: object) -> dict[str, str]:
    """Return the sha256 of a plugin's weights by file name."""
    weights = getattr(plugin, "weights", None)
    return dict(weights()) if callable(weights) else {}


def _members(protocol: type) -> list[str]:
    names = set(getattr(protocol, "__annotations__", {})) | {
        name for name, value in vars(protocol).items() if callable(value)
    }
    return sorted(name for name in names if not name.startswith("_"))
