"""Errors of the command line itself, in one line like every other."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator, Sequence

from megloc_kapture.cli.examples import examples_text

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_RULE = re.compile(r"[─-]{3,}")
# what the box says besides: where help is found, and the help itself
_BESIDES = ("For full helptext", "Argument helptext", "Perhaps you meant", "Got errors")
# help of a flag stands two steps in, its name one
_HELP_INDENT = " " * 8


@contextlib.contextmanager
def one_line_errors(arguments: Sequence[str]) -> Iterator[None]:
    """Turn the box that tyro draws around an argument error into one line on standard error.

    tyro has no public call for its errors' texts, so its drawing is read: nothing else is
    printed to standard error while arguments are parsed.
    """
    drawn = io.StringIO()
    # help goes to people: it keeps the width of their terminal
    asks_help = not {"-h", "--help"}.isdisjoint(arguments)
    width = contextlib.nullcontext() if asks_help else _wide_terminal()
    try:
        with width, contextlib.redirect_stderr(drawn):
            yield
    except SystemExit as end:
        if end.code:
            print(f"megloc: {summary(drawn.getvalue())}", file=sys.stderr)
        elif asks_help:
            print(examples_text(arguments))
        raise
    print(drawn.getvalue(), end="", file=sys.stderr)


def summary(drawn: str) -> str:
    """The text of a drawn box without its frame and what stands in it besides, on one line."""
    first, *lines = _COLOUR.sub("", drawn).splitlines() or [""]
    # where standard output knows no more than ASCII, the frame is of blanks, with a rule
    if not (first.startswith("╭") or (lines and _RULE.fullmatch(lines[0].strip()))):
        return " ".join(drawn.split()) or "the arguments cannot be used"
    title = first.strip("╭─╮ ")
    sections: list[list[str]] = [[]]
    for line in lines:
        text = line[2:].rstrip(" │╯")
        if not text or _RULE.fullmatch(text):
            sections.append([])
        elif not text.startswith(_HELP_INDENT):
            sections[-1].append(text)
    told = [_joined(s) for s in sections if s and not s[0].startswith(_BESIDES)]
    told = told or [title]
    helped = re.search(r"megloc(?: [a-z-]+){0,2} --help", drawn)
    if not told[0].startswith((title, "Missing", "Error", "invalid")):
        told[0] = f"{title}: {told[0]}"
    told.append(f"see {helped[0] if helped else 'megloc --help'}")
    return "; ".join(text.rstrip(".") for text in told)


def _joined(lines: list[str]) -> str:
    """Lines to one: what is set in is a list."""
    text = lines[0]
    listed = False
    for line in lines[1:]:
        text += (", " if listed and line.startswith(" ") else " ") + line.strip()
        listed = line.startswith(" ")
    return text


@contextlib.contextmanager
def _wide_terminal() -> Iterator[None]:
    """No box is so wide that its lines have to be wrapped while the block runs."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
