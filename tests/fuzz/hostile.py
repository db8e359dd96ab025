"""Content for readers: every way to write a number, and a pickle that runs code."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

NUMBERS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.floats(-1e6, 1e6).map("{:.10f}".format),  # kapture's own writer
    st.floats(allow_nan=False, allow_infinity=False).map("{:.18e}".format),
    st.floats(allow_nan=False, allow_infinity=False).map("{:.25e}".format),
    st.decimals(
        allow_nan=False, allow_infinity=False, places=30, min_value=-100, max_value=100
    ).map("{:f}".format),
    st.builds(
        "{}{}{}{}".format,
        st.sampled_from(["", "-", "+", "0", "-00"]),
        st.from_regex(r"[0-9]{1,25}", fullmatch=True),
        st.sampled_from(["", "."]) | st.from_regex(r"\.[0-9]{1,25}", fullmatch=True),
        st.just("") | st.integers(-340, 300).map("e{}".format),
    ),
    # half-way cases, where a wrong last digit would show
    st.integers(2**53, 2**56).map(str),
    st.integers(2**52, 2**53 - 1).map(lambda m: f"{m}.5"),
    st.sampled_from(
        ["4.9e-324", "2.2250738585072011e-308", "1.7976931348623157e308", "9007199254740993"]
    ),
).filter(lambda text: np.isfinite(float(text)))


class Runs:
    """Pickled as a call; unpickled by pickle itself it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self.folder),)
