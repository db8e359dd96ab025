"""Options by preset, file and assignment: all build the same model, and refuse what is not one."""

from __future__ import annotations

import pytest

from megloc_kapture.errors import DataError, OptionError, PluginError
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
    options = options_of_preset(changes=[changes])
    assert options == options_of_preset(assignments=assignments)
    assert options.matching.options == {"max_ratio": 0.9}
    assert options.matching.name == "nn"
    assert options.query_pairs.top_k == 5


def test_the_last_assignment_counts_and_beats_the_tables() -> None:
    options = options_of_preset(
        changes=[{"query_pairs": {"top_k": 4}}, {"query_pairs": {"top_k": 5}}],
        assignments=["query_pairs.top_k=6", "query_pairs.top_k=7"],
    )
    assert options.query_pairs.top_k == 7
    tables = [{"query_pairs": {"top_k": 4}}, {"query_pairs": {"top_k": 5}}]
    assert options_of_preset(changes=tables).query_pairs.top_k == 5


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
        (
            "querypairs.top_k=3",
            "unknown option querypairs; did you mean 'query_pairs'. known here: ",
        ),
        (
            "query_pairs.topk=3",
            "unknown option query_pairs.topk; did you mean 'top_k'. known here: by, ",
        ),
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
    with pytest.raises(OptionError, match="unknown preset 'best'; known: classic, megloc, modern"):
        options_of_preset("best")


@pytest.mark.parametrize(
    ("assignments", "expected"),
    [
        (["local_features=sift"], {"sift": {}}),
        (["local_features.name=sift"], {"sift": {}}),
        (
            ["local_features=sift", "local_features.sift.options.max_keypoints=7"],
            {"sift": {"max_keypoints": 7}},
        ),
        (['local_features=["sift", "rootsift"]'], {"sift": {}, "rootsift": {}}),
        (
            [
                'local_features=["sift", "rootsift"]',
                "local_features.sift.options.max_keypoints=7",
                "local_features.rootsift.options.max_keypoints=8",
            ],
            {"sift": {"max_keypoints": 7}, "rootsift": {"max_keypoints": 8}},
        ),
        (
            ["local_features.rootsift.options.max_keypoints=9"],
            {"rootsift": {"max_keypoints": 9}},
        ),
    ],
)
def test_local_features_are_named_alone_or_in_a_list(
    assignments: list[str], expected: dict[str, dict[str, int]]
) -> None:
    options = options_of_preset(assignments=assignments)
    assert {one.name: one.options for one in options.local_features} == expected
    assert options.local_types() == list(expected)
    assert options.main_type() == next(iter(expected))


def test_one_of_several_types_is_named_to_change_it() -> None:
    several = 'local_features=["sift", "rootsift"]'
    with pytest.raises(OptionError, match=r"name one of them: local_features\.sift, local_f"):
        options_of_preset(assignments=[several, "local_features.options.max_keypoints=7"])
    with pytest.raises(OptionError, match="'sift' is asked for twice"):
        options_of_preset(assignments=['local_features=["sift", "sift"]']).local_types()
    with pytest.raises(OptionError, match="local_features: .*at least 1 item"):
        options_of_preset(assignments=["local_features=[]"])


@pytest.mark.parametrize("name", ["megloc", "modern"])
def test_a_preset_without_its_weights_names_file_place_and_command(name: str) -> None:
    options = options_of_preset(name)
    file = {"megloc": "superpoint_v1.pth", "modern": "aliked-n16.pth"}[name]
    with pytest.raises(DataError, match=rf"{file} .*https://github.com/.*megloc weights fetch"):
        options.make_extractors()


def test_a_type_may_have_a_matcher_of_its_own() -> None:
    options = options_of_preset(
        assignments=[
            'local_features=["sift", "rootsift"]',
            "local_features.sift.matching.name=nn",
            "local_features.sift.matching.options.max_ratio=0.8",
        ]
    )
    assert options.make_matcher("sift").options.max_ratio == 0.8  # type: ignore[attr-defined]
    assert options.make_matcher("rootsift").options.max_ratio is None  # type: ignore[attr-defined]


def test_plugins_are_made_with_their_options() -> None:
    options = options_of_preset(
        assignments=["local_features.options.max_keypoints=7", "verification=none"]
    )
    (extractor,) = options.make_extractors()
    assert extractor.name == "rootsift"
    assert extractor.options.max_keypoints == 7  # type: ignore[attr-defined]
    assert options.verify_queries() == options.verify_mapping()
    assert options_of_preset().verify_queries() != options_of_preset().verify_mapping()
    with pytest.raises(PluginError, match="no plugin 'surf' .*; registered: .*nn"):
        options_of_preset(assignments=["matching.name=surf"]).make_matcher("rootsift")
