"""``megloc``: parse, run, and turn errors into one line and an exit status."""

from __future__ import annotations

import functools
import operator
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any, Protocol

import tyro

from megloc_kapture.cli.arguments import one_line_errors
from megloc_kapture.cli.check import Check
from megloc_kapture.cli.datasets import Import, Synth
from megloc_kapture.cli.doctor import Doctor
from megloc_kapture.cli.evaluate import Evaluate
from megloc_kapture.cli.evaluate_dataset import Eval
from megloc_kapture.cli.info import Info
from megloc_kapture.cli.localize import Localize
from megloc_kapture.cli.preprocess import Preprocess
from megloc_kapture.cli.refine_map import RefineMap
from megloc_kapture.cli.refine_poses import RefinePoses
from megloc_kapture.cli.retrieval import ExtractGlobal, PairsMapping, PairsQuery
from megloc_kapture.cli.stages import ExtractLocal, Match, Triangulate
from megloc_kapture.cli.submit import Submit
from megloc_kapture.cli.weights import WeightsCommand
from megloc_kapture.errors import MeglocError

DONE, DEFECT, USER_ERROR, INTERRUPTED = 0, 1, 2, 130


class Command(Protocol):
    """A command: its flags are its fields."""

    debug: bool

    def run(self) -> int:
        """Run it; returns the exit status."""
        ...


COMMANDS: dict[str, type[Any]] = {
    "eval": Eval,
    "import": Import,
    "synth": Synth,
    "preprocess": Preprocess,
    "extract-local": ExtractLocal,
    "extract-global": ExtractGlobal,
    "pairs-mapping": PairsMapping,
    "pairs-query": PairsQuery,
    "match": Match,
    "triangulate": Triangulate,
    "refine-map": RefineMap,
    "refine-poses": RefinePoses,
    "localize": Localize,
    "submit": Submit,
    "check": Check,
    "evaluate": Evaluate,
    "weights": WeightsCommand,
    "info": Info,
    "doctor": Doctor,
}


def _parser() -> Any:
    annotated: Any = Annotated  # of types that are values here, which mypy does not follow
    entries = [
        annotated[kind, tyro.conf.subcommand(name, description=kind.__doc__)]
        for name, kind in COMMANDS.items()
    ]
    return functools.reduce(operator.or_, entries)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script; exits with 0, 1 (defect), 2 (user's error) or 3."""
    given = sys.argv[1:] if arguments is None else arguments
    debug = False
    try:
        with one_line_errors(given):
            command: Command = tyro.cli(
                _parser(), args=given, prog="megloc", config=(tyro.conf.OmitArgPrefixes,)
            )
        debug = command.debug
        status = command.run()
        sys.stdout.flush()
    except MeglocError as error:
        if debug:
            traceback.print_exc()
        print(f"megloc: {' '.join(str(error).split())}", file=sys.stderr)
        status = USER_ERROR
    except KeyboardInterrupt:
        print("megloc: interrupted; run the same command again to go on", file=sys.stderr)
        status = INTERRUPTED
    except BrokenPipeError:
        # who reads our output has gone; the flush at exit must not complain about it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = DONE
    sys.exit(status)
