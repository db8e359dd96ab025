"""What a person sees: progress, lines, errors."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterable, Iterator
from datetime import timedelta
from typing import Any, TypeVar

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
            from rich.progress import Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

            class Rate(TaskProgressColumn):
                def render(self, task: Any) -> Any:
                    return self.render_speed(task.finished_speed or task.speed)

            bar, of = Progress.get_default_columns()[1], TextColumn("{task.completed}/{task.total}")
            columns = (TextColumn("{task.description}"), bar, of, Rate(), TimeRemainingColumn())
            with Progress(*columns, console=RichConsole(stderr=True), transient=True) as progress:
                yield from progress.track(items, total=total, description=f"  {label}")
        else:
            started = shown = time.monotonic()
            for number, item in enumerate(items, start=1):
                yield item
                now = time.monotonic()
                if now - shown > _LINE_EVERY_S and number < total:
                    shown = now
                    rate = number / (now - started)
                    left = timedelta(seconds=round((total - number) / rate))
                    self.say(f"  {label}: {number} of {total}, {rate:.2g}/s, {left} left")


def configure_logging(level: str) -> None:
    """Log to standard error at a level by name."""
    logging.basicConfig(
        level=getattr(logging, level.upper()), format="%(levelname)s %(name)s: %(message)s"
    )
