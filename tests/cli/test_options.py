"""``megloc options``, ``--version``, and names that are nearly right."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import pytest

import megloc_kapture
from megloc_kapture.cli.info import shown
from megloc_kapture.pipeline.presets import PRESETS, options_of, options_of_preset
from megloc_kapture.stages.options import PipelineOptions


def test_every_option_is_listed_with_a_meaning(megloc: Any) -> None:
    told = megloc("options").out
    every = list(options_of(PipelineOptions()))
    assert len(every) > 80
    for option in every:
        assert f"\n{option.key} = {shown(option.value)}\n" in f"\n{told}"
        assert option.meaning and option.meaning in told, option.key


@pytest.mark.parametrize("preset", PRESETS)
def test_a_value_is_shown_as_set_takes_it(preset: str) -> None:
    for option in options_of(PRESETS[preset]):
        text = f"{option.key}={shown(option.value)}"
        if isinstance(option.value, tuple) or option.key == "stages" or "none" in text:
            continue
        try:
            changed = options_of_preset(preset, assignments=[text])
        except megloc_kapture.OptionError as refused:
            # options that change nothing there are refused for that, not for their value
            assert "changes nothing" in str(refused), text
            continue
        found = {one.key: one.value for one in options_of(changed)}[option.key]
        if isinstance(found, float):
            assert found == pytest.approx(option.value, rel=1e-3)
        else:
            assert found == option.value, text


def test_a_step_one_option_and_a_plugin(megloc: Any) -> None:
    told = megloc("options", "query_pairs", "--preset", "megloc").out
    assert told.startswith("query_pairs.by = retrieval\n    'retrieval' | 'exhaustive'; ")
    assert "query_pairs.top_k = 50\n" in told and "mapping_pairs" not in told
    assert megloc("options", "query_pairs.top_k").out.count("\n") == 2
    assert "aliked: options.threshold = 0.2\n" in megloc("options", "aliked").out
    assert "vlad: options." in megloc("options", "vlad").out


def test_names_that_are_nearly_right(megloc: Any) -> None:
    megloc("options", "localisation").refused("did you mean localization")
    megloc("options", "--preset", "moden").refused("did you mean 'modern'\\? known: classic")
    megloc("eval", "aachn").refused("did you mean 'aachen'\\? known: ")
    for text, meant in (
        ("query_pairs.topk=3", "'top_k'"),
        ("radius=3", "localization.clusters.radius"),
        ("local_features=aliqued", "'aliked'"),
    ):
        megloc("eval", "synthetic-aachen", "--set", text).refused(f"did you mean {meant}")
    megloc("weights", "fetch", "alikd-n16").refused("did you mean 'aliked-n16'")


def test_the_version(megloc: Any) -> None:
    assert megloc("--version").out == f"megloc-kapture {version('megloc-kapture')}\n"
    assert megloc_kapture.__version__ == version("megloc-kapture")
