"""Options by preset, file and assignment: all build the same model, and refuse what is not one."""

from __future__ import annotations

from operator import attrgetter

import pytest

from megloc_kapture.errors import DataError, OptionError, PluginError
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours
from megloc_kapture.pipeline.presets import (
    PRESETS,
    PipelineOptions,
    assigned,
    options_of,
    options_of_preset,
)


def test_assignments_and_tables_build_the_same_and_the_last_counts() -> None:
    assert options_of_preset("classic") == PRESETS["classic"] == PipelineOptions()
    assert options_of_preset(assignments=["query_pairs.top_k=50"]) == PipelineOptions()
    changes = {"matching": {"options": {"max_ratio": 0.9}}, "query_pairs": {"top_k": 5}}
    assignments = ["matching.options.max_ratio=0.9", "query_pairs.top_k = 5"]
    options = options_of_preset(changes=[changes])
    assert options == options_of_preset(assignments=assignments)
    assert options.matching.options == {"max_ratio": 0.9} and options.matching.name == "nn"
    tables = [{"query_pairs": {"top_k": 4}}, {"query_pairs": {"top_k": 5}}]
    assert options_of_preset(changes=tables).query_pairs.top_k == 5
    typed = ["query_pairs.top_k=6", "query_pairs.top_k=7"]
    assert options_of_preset(changes=tables, assignments=typed).query_pairs.top_k == 7


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


def test_none_turns_off_what_may_be_off_and_is_a_choice_of_other_options() -> None:
    off, chosen = set(), set()
    for option in options_of(PipelineOptions()):
        if "None" in option.kind or "'none'" in option.kind:
            options = options_of_preset(changes=[assigned([f"{option.key}=none"])])
            found = attrgetter(option.key)(options)
            (off if "None" in option.kind else chosen).add(option.key)
            assert found == (None if "None" in option.kind else "none"), option.key
    assert {"refinement.depth.max_sigmas", "preprocessing.masks.segmenter"} <= off
    assert {"reranking.by", "localization.fallback", "localization.clusters.by"} <= chosen
    with pytest.raises(OptionError, match="option query_pairs.top_k: .*integer"):
        options_of_preset(assignments=["query_pairs.top_k=none"])
    # those of plugins, which they check themselves
    assert NearestNeighbours.Options(max_ratio="none").max_ratio is None


SEVERAL = 'local_features=["sift", "rootsift"]'


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (["query_pairs.top_k"], "--set takes key=value, got 'query_pairs.top_k'"),
        (["=3"], "--set takes key=value"),
        (["querypairs.top_k=3"], r"option querypairs; did you mean query_pairs\?"),
        (["query_pairs.topk=3"], r"query_pairs.topk; did you mean query_pairs.top_k\?"),
        (["query_pairs.top_k=many"], "option query_pairs.top_k: "),
        (["query_pairs.top_k=0"], "option query_pairs.top_k: "),
        (["query_pairs=3"], "option query_pairs: "),
        (["verification=maybe"], "option verification: .*'geometric', 'mapping' or 'none'"),
        (["localization.fallback=guess"], "option localization.fallback: "),
        (["local_features=[]"], "local_features: .*at least 1 item"),
        (
            [SEVERAL, "local_features.options.max_keypoints=7"],
            r"choose one of: local_features\.sift, local_f",
        ),
    ],
)
def test_what_is_no_option_is_refused_by_name(assignments: list[str], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        options_of_preset(assignments=assignments)


def test_an_unknown_preset_lists_the_known() -> None:
    with pytest.raises(OptionError, match="unknown preset 'best'; known: classic, megloc, modern"):
        options_of_preset("best")


@pytest.mark.parametrize(
    ("assignments", "expected"),
    [
        (["local_features=sift"], {"sift": None}),
        (["local_features.name=sift"], {"sift": None}),
        (["local_features=sift", "local_features.sift.options.max_keypoints=7"], {"sift": 7}),
        ([SEVERAL], {"sift": None, "rootsift": None}),
        (
            [
                *(SEVERAL, "local_features.sift.options.max_keypoints=7"),
                "local_features.rootsift.options.max_keypoints=8",
            ],
            {"sift": 7, "rootsift": 8},
        ),
        (["local_features.rootsift.options.max_keypoints=9"], {"rootsift": 9}),
    ],
)
def test_local_features_are_named_alone_or_in_a_list(
    assignments: list[str], expected: dict[str, int | None]
) -> None:
    options = options_of_preset(assignments=assignments)
    found = {one.name: one.options.get("max_keypoints") for one in options.local_features}
    assert found == expected
    assert all(one.options.keys() <= {"max_keypoints"} for one in options.local_features)
    assert options.local_types() == list(expected)
    assert options.main_type() == next(iter(expected))


def test_one_type_twice_is_refused() -> None:
    with pytest.raises(OptionError, match="'sift' is listed twice"):
        options_of_preset(assignments=['local_features=["sift", "sift"]']).local_types()


@pytest.mark.parametrize(
    ("name", "file"), [("megloc", "superpoint_v1.pth"), ("modern", "aliked-n16.pth")]
)
def test_a_preset_without_its_weights_names_file_place_and_command(name: str, file: str) -> None:
    with pytest.raises(DataError, match=rf"{file} .*https://github.com/.*megloc weights fetch"):
        options_of_preset(name).make_extractors()


def test_plugins_are_made_with_their_options() -> None:
    options = options_of_preset(
        assignments=["local_features.options.max_keypoints=7", "verification=none"]
    )
    (extractor,) = options.make_extractors()
    assert extractor.name == "rootsift"
    assert extractor.options.max_keypoints == 7  # type: ignore[attr-defined]
    assert options.verify_queries() == options.verify_mapping()
    assert options_of_preset().verify_queries() != options_of_preset().verify_mapping()
    # a type may have a matcher of its own
    own = ["local_features.sift.matching.name=nn"]
    own += ["local_features.sift.matching.options.max_ratio=0.8"]
    of_two = options_of_preset(assignments=[SEVERAL, *own])
    for name, max_ratio in (("sift", 0.8), ("rootsift", None)):
        assert of_two.make_matcher(name).options.max_ratio == max_ratio  # type: ignore[attr-defined]
    with pytest.raises(PluginError, match="no plugin 'surf' .*; registered: .*nn"):
        options_of_preset(assignments=["matching.name=surf"]).make_matcher("rootsift")
