"""The lines of a text model, one by one or in chunks for the compiled loops."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import NamedTuple

import numpy as np

from megloc_kapture.datasets.grammars.binary_file import check_plain
from megloc_kapture.io.text_chunks import CHUNK_BYTES, Chunk, read_chunks

# from here on the compiled loops are faster than what importing them takes
LARGE_BYTES = 1 << 22


class Line(NamedTuple):
    """One line: its number, its content without the break and where it stands in the text."""

    number: int
    content: bytes
    chunk: Chunk
    begin: int


class ModelLines:
    """Reads a file from its beginning to its end, in bounded memory.

    Raises
    ------
    DataError : missing, not readable, or not a plain file.
    """

    def __init__(self, path: Path, *, chunk_bytes: int = CHUNK_BYTES) -> None:
        self.path = Path(path)
        check_plain(self.path)
        self._chunks = read_chunks(self.path, chunk_bytes)
        self._ahead: deque[Chunk] = deque()
        self._content: bytes | None = None
        self.last_line = 0

    def chunk(self, index: int = 0) -> Chunk | None:
        """The chunk ``index`` chunks ahead; the first begins with the next line. None: no more."""
        while len(self._ahead) <= index:
            following = next(self._chunks, None)
            if following is None:
                return None
            self._ahead.append(following)
        return self._ahead[index]

    def advance(self, position: int) -> None:
        """Go on to the line at ``position`` of the first chunk."""
        chunk = self._ahead[0]
        passed = int(np.count_nonzero(chunk.text[chunk.begin : position] == 10))
        self._move(position, passed)

    def line(self) -> Line | None:
        """The next line, blank or not; None at the end."""
        chunk = self.chunk()
        if chunk is None:
            return None
        if self._content is None:
            self._content = chunk.text[: chunk.end].tobytes()
        end = self._content.index(b"\n", chunk.begin)
        line = Line(chunk.first_line, self._content[chunk.begin : end], chunk, chunk.begin)
        self._move(end + 1, 1)
        return line

    def row(self) -> Line | None:
        """The next line that is not blank; None at the end."""
        while (line := self.line()) is not None:
            if line.content.strip():
                return line
        return None

    def _move(self, position: int, lines: int) -> None:
        chunk = self._ahead[0]
        self.last_line = chunk.first_line + lines - 1
        if position >= chunk.end:
            self._ahead.popleft()
            self._content = None
        else:
            self._ahead[0] = chunk._replace(begin=position, first_line=self.last_line + 1)


def is_large(path: Path, large_bytes: int) -> bool:
    """Whether a file is worth the compiled loops."""
    try:
        return path.stat().st_size >= large_bytes
    except OSError:
        return False  # who opens it says what is wrong
