"""Pairs of an MLAD file against those that are asked for."""

from __future__ import annotations

from megloc_kapture.evaluation.check.pairs import match_pairs

PAIRS = {("1", "10"): None, ("2", "20"): None, ("3", "30"): None}


def test_pairs() -> None:
    assert match_pairs({"1 10": 1, "2 20": 2, "3 30": 3}, PAIRS) == (False, [])
    swapped, findings = match_pairs({"10 1": 1, "20 2": 2, "30 3": 3}, PAIRS)
    assert swapped and [f.kind for f in findings] == ["swapped"]
    swapped, findings = match_pairs({"3 30": 1, "1 10": 2, "2 30": 3}, PAIRS)
    assert not swapped
    assert [(f.severity, f.kind, f.line) for f in findings] == [
        ("error", "unknown", 3),
        ("error", "missing", None),
        ("note", "order", None),
    ]
    assert findings[1].names == ("2 20",)
