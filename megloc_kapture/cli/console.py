"""What a person sees: progress, lines, errors."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterable, Iterator
from datetime import timedelta
from typing import TypeVar

Item = TypeVar("Item")

_LINE_EVERY_S = 10.0


class Console:
    """Progress bars on a terminal, plain lines elsewhere; results go to standard output."""

    def __init__(self, *, quiet: bool = False) -> None:
        self.quiet = quiet
        self.terminal = sys.stderr.isatty()

    def say(self, text: str) -> None:
        """A line about what goes on; to standard error, so that results can be piped."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def result(self, text: str) -> None:
        """A line of the result."""
        print(text, flush=True)

    def track(self, items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
        """Yield the items and show how far it is."""
        if self.quiet:
            yield from items
        elif self.terminal:
            from rich.console import Console as RichConsole
            from rich.progress import track

            yield from track(
                items,
                description=f"  {label}",
                total=total,
                console=RichConsole(stderr=True),
                transient=True,
            )
        else:
            started = shown = time.monotonic()
            for number, item in enumerate(items, start=1):
                yield item
                now = time.monotonic()
                if now - shown > _LINE_EVERY_S and number < total:
                    shown = now
                    left = timedelta(seconds=round((now - started) / number * (total - number)))
                    self.say(f"  {label}: {number} of {total}, {left} left")


def configure_logging(level: str) -> None:
    """Log to standard error at a level by name."""
    logging.basicConfig(
        level=getattr(logging, level.upper()), format="%(levelname)s %(name)s: %(message)s"
    )
