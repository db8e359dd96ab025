"""Content for readers: random changes, and a pickle that runs code."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

# what parsers of numbers, tables and paths trip over
TOKENS = st.sampled_from(
    [b"nan", b"-inf", b"1e999", b"-1", b"0", b"1", b"2", b"9" * 11, b"18446744073709551616"]
    + [b"1_0", b"0x1", b".5", b"5.", b"-.5e-3", b"+7", b"1e", b"9" * 19, b"9" * 400, b"256"]
    + [b"179769313486231570000e290", b"8.5070591730234615e37", b"1.7014118346046923e38", b"-0.0"]
    + [b"2147483648", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\xef\xbb\xbf", b"\xd9\xa1"]
    + [b" ", b"\t", b"\x0b", b"\x1c", b"\x85", b"\xc2\xa0", b"\xe2\x80\x83", b"\xc3\xa9", b"\xff"]
    + [b"\0", b"\n", b"\n\n\n", b"\r\n", b"\r", b",", b", ", b"#", b'"', b"-", b"{", b"[", b"\\"]
    + [b"..", b"/", b"../x", b"cam", b"rig", b"# kapture format: 1.1\n"]
)
_OFFSETS = st.integers(0, 1 << 16)
Edit = tuple[str, int, Any]
EDITS = st.lists(
    st.one_of(
        st.tuples(st.just("insert"), _OFFSETS, TOKENS | st.binary(max_size=30)),
        st.tuples(st.just("token"), _OFFSETS, TOKENS),
        st.tuples(st.just("delete"), _OFFSETS, st.integers(1, 40)),
        st.tuples(st.just("double"), _OFFSETS, st.integers(1, 80)),
        st.tuples(st.just("byte"), _OFFSETS, st.integers(0, 255)),
        st.tuples(st.just("cut"), _OFFSETS, st.none()),
    ),
    min_size=1,
    max_size=6,
)


def changed(content: bytes, edits: list[Edit]) -> bytes:
    """Apply edits; offsets wrap around the length."""
    for kind, offset, value in edits:
        k = offset % (len(content) + 1)
        if kind == "insert":
            content = content[:k] + value + content[k:]
        elif kind == "token":  # instead of a field
            end = min((e for e in (content.find(c, k) for c in b" ,\n") if e >= 0), default=k)
            begin = max(content.rfind(c, 0, end) for c in (b" ", b",", b"\n")) + 1
            content = content[:begin] + value + content[end:]
        elif kind == "delete":
            content = content[:k] + content[k + value :]
        elif kind == "double":
            content = content[: k + value] + content[k:]
        elif kind == "byte":
            content = content[:k] + bytes([value]) + content[k + 1 :]
        else:
            content = content[:k]
    return content


class Runs:
    """Pickled as a call; unpickled by pickle itself it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self.folder),)
