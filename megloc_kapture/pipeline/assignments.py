"""Options that a user typed: each must be one that something acts on."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from megloc_kapture.errors import OptionError
from megloc_kapture.values import Options


def check_assigned(
    options: Options,
    assigned: Mapping[str, Any],
    *,
    used: Collection[str] | None = None,
) -> None:
    """Refuse options that were typed and change nothing.

    Parameters
    ----------
    options : with all changes.
    assigned : nested tables of what was typed.
    used : options that the command acts on; None: all.

    Raises
    ------
    OptionError : an option that the command does not use, or that another option makes idle.
    """
    for name in assigned:
        if used is not None and name not in used:
            raise OptionError(
                f"--set {name}: nothing here uses it; used are: {', '.join(sorted(used))}"
            )
    for path, reason in _idle(options, assigned, ()):
        raise OptionError(f"--set {'.'.join(path)} changes nothing: {reason}")


def _idle(
    model: Options, assigned: Mapping[str, Any], above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Paths of assigned options that change nothing, and why."""
    idle = model.idle()
    for name, value in assigned.items():
        path = (*above, name)
        if name in idle:
            yield path, idle[name]
            continue
        inner = getattr(model, name, None)
        if isinstance(inner, Options) and isinstance(value, Mapping):
            yield from _idle(inner, value, path)
        elif isinstance(inner, tuple) and isinstance(value, Mapping):
            yield from _idle_in_list(inner, value, path)


def _idle_in_list(
    choices: Sequence[Any], assigned: Mapping[str, Any], path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], str]]:
    """The same in a list of plugins, of which the only one, or those that are named, change."""
    for name, value in assigned.items():
        named = [one for one in choices if getattr(one, "name", None) == name]
        if named and isinstance(value, Mapping):
            for one in named:
                yield from _idle_in_list([one], value, (*path, name))
        elif name == "weight" and len(choices) == 1:
            yield (*path, name), "it is the share among several, and there is one"
