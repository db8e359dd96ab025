"""Options by preset, file and assignment: all build the same model, and refuse what is not one."""

from __future__ import annotations

import pytest

from megloc_kapture.errors import OptionError, PluginError
from megloc_kapture.pipeline.presets import (
    PRESETS,
    PipelineOptions,
    options_of_preset,
)


def test_a_preset_unchanged_is_the_preset() -> None:
    assert options_of_preset("classic") == PRESETS["classic"] == PipelineOptions()
    assert options_of_preset(assignments=["query_pairs.top_k=50"]) == PipelineOptions()


def test_assignments_and_tables_build_the_same() -> None:
    changes = {"matching": {"options": {"max_ratio": 0.9}}, "query_pairs": {"top_k": 5}}
    assignments = ["matching.options.max_ratio=0.9", "query_pairs.top_k = 5"]
    options = options_of_preset(changes=changes)
    assert options == options_of_preset(assignments=assignments)
    assert options.matching.options == {"max_ratio": 0.9}
    assert options.matching.name == "nn"
    assert options.query_pairs.top_k == 5


def test_the_last_assignment_counts_and_beats_the_table() -> None:
    options = options_of_preset(
        changes={"query_pairs": {"top_k": 5}},
        assignments=["query_pairs.top_k=6", "query_pairs.top_k=7"],
    )
    assert options.query_pairs.top_k == 7


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("none", "none"),
        ("None", None),
        ("null", None),
        ("3", 3),
        ("0.5", 0.5),
        ("true", True),
        ('"quoted"', "quoted"),
        ("plain", "plain"),
        ("[1, 2]", [1, 2]),
        ("a=b", "a=b"),
        ("", ""),
    ],
)
def test_values(text: str, value: object) -> None:
    options = options_of_preset(assignments=[f"matching.options.x={text}"])
    found = options.matching.options["x"]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("query_pairs.top_k", "--set takes key=value, got 'query_pairs.top_k'"),
        ("=3", "--set takes key=value"),
        ("querypairs.top_k=3", "unknown option querypairs; known here: .*query_pairs"),
        ("query_pairs.topk=3", "unknown option query_pairs.topk; known here: by, top_k"),
        ("query_pairs.top_k=many", "option query_pairs.top_k: "),
        ("query_pairs.top_k=0", "option query_pairs.top_k: "),
        ("query_pairs=3", "option query_pairs: "),
        ("verification=maybe", "option verification: .*'geometric' or 'none'"),
        ("localization.fallback=guess", "option localization.fallback: "),
    ],
)
def test_what_is_no_option_is_refused_by_name(assignment: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        options_of_preset(assignments=[assignment])


def test_an_unknown_preset_lists_the_known() -> None:
    with pytest.raises(OptionError, match="unknown preset 'best'; known: classic"):
        options_of_preset("best")


def test_plugins_are_made_with_their_options() -> None:
    options = options_of_preset(
        assignments=["local_features.options.max_keypoints=7", "verification=none"]
    )
    extractor = options.make_extractor()
    assert extractor.name == "rootsift"
    assert extractor.options.max_keypoints == 7  # type: ignore[attr-defined]
    assert options.verify_queries() == options.verify_mapping()
    assert options_of_preset().verify_queries() != options_of_preset().verify_mapping()
    with pytest.raises(PluginError, match="no plugin 'surf' .*; registered: nn"):
        options_of_preset(assignments=["matching.name=surf"]).make_matcher()
