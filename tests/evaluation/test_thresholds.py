"""Thresholds: parsing, printing, refusals."""

from __future__ import annotations

import pytest

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.thresholds import DEFAULT_THRESHOLDS, Threshold


@pytest.mark.parametrize(
    ("text", "position_m", "angle_deg", "printed"),
    [
        ("0.25,2", 0.25, 2.0, "0.25 m, 2 deg"),
        ("5 10", 5.0, 10.0, "5 m, 10 deg"),
        (" 0.1 ", 0.1, None, "0.1 m"),
        ("0,0", 0.0, 0.0, "0 m, 0 deg"),
    ],
)
def test_parse_and_print(
    text: str, position_m: float, angle_deg: float | None, printed: str
) -> None:
    threshold = Threshold.parse(text)
    assert (threshold.position_m, threshold.angle_deg) == (position_m, angle_deg)
    assert str(threshold) == printed


@pytest.mark.parametrize("text", ["", "x", "0.25,x", "1,2,3", "-1,2", "1,-2", "nan,2", "inf,2"])
def test_refused(text: str) -> None:
    with pytest.raises(OptionError, match="METRES,DEGREES"):
        Threshold.parse(text)


def test_defaults() -> None:
    assert [str(threshold) for threshold in DEFAULT_THRESHOLDS] == [
        "0.05 m, 5 deg",
        "0.25 m, 2 deg",
        "0.5 m, 5 deg",
        "5 m, 10 deg",
    ]
