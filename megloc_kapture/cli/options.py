"""``megloc options``: every option with its value, type and meaning."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import tyro

from megloc_kapture.cli.common import Common
from megloc_kapture.errors import OptionError
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.pipeline.presets import (
    DEFAULT_PRESET,
    Option,
    options_of,
    options_of_preset,
)
from megloc_kapture.plugin_loading import plugin_class, plugin_names
from megloc_kapture.plugins import (
    DATASETS,
    GLOBAL_FEATURES,
    LOCAL_FEATURES,
    MATCHERS,
    POSE_RANKERS,
    POSE_REFINERS,
    SEGMENTERS,
    PluginChoice,
)
from megloc_kapture.stages.global_features import VLAD
from megloc_kapture.values import Options


@dataclass(frozen=True, kw_only=True)
class OptionsCommand(Common):
    """List the options that --set takes, with value, type and meaning."""

    key: tyro.conf.Positional[str] = ""
    """Those of a step (localization.pose), one of them, or those of a plugin (aliked)."""
    preset: str = DEFAULT_PRESET
    """Show the values of this preset."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        every = list(options_of(options_of_preset(self.preset)))
        found = [one for one in every if _is_below(one.key, self.key)]
        if not found:
            found = list(_options_of_plugins(self.key))
        if not found:
            steps = {one.key.rpartition(".")[0] for one in every} - {""}
            known = sorted({*(one.key for one in every), *steps, *_plugins()})
            near = get_close_matches(self.key, known, n=3)
            hint = f"did you mean {' or '.join(near)}? " if near else ""
            raise OptionError(
                f"no option, step or plugin {self.key!r}; {hint}`megloc options` lists all options"
            )
        for one in found:
            console.result(f"{one.key} = {shown(one.value)}")
            console.result(f"    {one.kind}{f'; {one.meaning}' if one.meaning else ''}")
        return 0


def shown(value: Any) -> str:
    """A value as ``--set`` takes it."""
    if isinstance(value, PluginChoice) and not value.options:
        return value.name
    if isinstance(value, Options):
        return json.dumps(value.model_dump(mode="json", exclude_defaults=True))
    if isinstance(value, tuple | list):
        return f"[{', '.join(shown(one) for one in value)}]"
    if value is None or isinstance(value, bool):
        return str(value).lower()
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _is_below(key: str, asked: str) -> bool:
    return not asked or key == asked or key.startswith(f"{asked}.")


def _plugins() -> dict[str, list[str]]:
    """The groups of each plugin that may have options."""
    found: dict[str, list[str]] = {VLAD: []}
    for group in (
        *(LOCAL_FEATURES, GLOBAL_FEATURES, MATCHERS, POSE_RANKERS, POSE_REFINERS),
        *(SEGMENTERS, DATASETS),
    ):
        for name in plugin_names(group):
            found.setdefault(name, []).append(group)
    return found


def _options_of_plugins(name: str) -> Iterator[Option]:
    if name == VLAD:
        yield from options_of(VladOptions(), f"{name}: options.")
    for group in _plugins().get(name, ()):
        model = getattr(plugin_class(group, name), "Options", None)
        if model is not None:
            yield from options_of(model(), f"{name}: options.")
