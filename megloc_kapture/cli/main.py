"""``megloc``: parse, run, and turn errors into one line and an exit status.

Heavy modules are imported within :func:`main`, where Ctrl-C is met by one line as well.
"""

from __future__ import annotations

import functools
import operator
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any, NoReturn, Protocol

from megloc_kapture.errors import MeglocError, missing_extra

DONE, DEFECT, USER_ERROR, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143


class Terminated(BaseException):
    """The system, or somebody, asks the process to end."""


class Command(Protocol):
    """A command: its flags are its fields."""

    debug: bool

    def run(self) -> int:
        """Run it; returns the exit status."""
        ...


# module and class, and the first line of its help: only the command that runs is imported
COMMANDS: dict[str, tuple[str, str]] = {
    "eval": (
        "evaluate_dataset:Eval",
        "Run all stages on a dataset; what is done and still true is kept.",
    ),
    "import": (
        "datasets:Import",
        "Bring a dataset into DIR/{mapping,query,query_gt,megloc}, or a COLMAP model into a map.",
    ),
    "synth": (
        "datasets:Synth",
        "Render a dataset: the synthetic world as kapture, or a small twin in an official layout.",
    ),
    "preprocess": (
        "preprocess:Preprocess",
        "Resize, undistort and mask the images of a kapture; poses stay, cameras follow.",
    ),
    "extract-local": (
        "stages:ExtractLocal",
        "Extract local features of all images of kapture folders.",
    ),
    "extract-global": (
        "retrieval:ExtractGlobal",
        "Describe every image by one vector: VLAD trained on the map, or image networks.",
    ),
    "pairs-mapping": (
        "retrieval:PairsMapping",
        "Choose which images of a map are matched with each other.",
    ),
    "pairs-query": ("retrieval:PairsQuery", "Choose the map images each query is matched with."),
    "match": (
        "stages:Match",
        "Match and verify image pairs; with known poses within a map, else by a two-view model.",
    ),
    "triangulate": (
        "stages:Triangulate",
        "Triangulate verified matches of images with known poses into a kapture map.",
    ),
    "refine-map": (
        "refine_map:RefineMap",
        "Take points and observations out of a map that its images, or depth maps, contradict.",
    ),
    "densify": (
        "densify:Densify",
        "Estimate depth of a map's images that have none, by multi-view stereo.",
    ),
    "refine-poses": (
        "refine_poses:RefinePoses",
        "Refine the poses of localized queries; a pose that gets no better stays, and says why.",
    ),
    "map": (
        "map_photographs:MapPhotographs",
        "Make a map of photographs without poses; what is done and still true is kept.",
    ),
    "localize": (
        "localize:Localize",
        "Localize photographs, or the images of a kapture folder, in a kapture map.",
    ),
    "serve": (
        "serve:Serve",
        "Localize images that come by HTTP in a kapture map; with a page for photographs.",
    ),
    "submit": (
        "submit:Submit",
        "Write the pose file of a localized kapture folder, and its provenance beside it.",
    ),
    "check": (
        "check:Check",
        "Check a pose file, ours or foreign, against the rules of its challenge and the map.",
    ),
    "evaluate": (
        "evaluate:Evaluate",
        "Compare localized queries (kapture folders or pose files) with their true poses, and two "
        "or more results with each other.",
    ),
    "export": (
        "export:Export",
        "Write a map, localized queries or both for COLMAP, nerfstudio, evo and viewers.",
    ),
    "view": (
        "view:View",
        "Write a page that shows a map in 3D, and the queries of a result in it; it needs no "
        "network.",
    ),
    "train": (
        "train:Train",
        "Train SuperGlue, or a detector's descriptors, on kapture folders with depth and on "
        "photographs.",
    ),
    "train-field": (
        "field:TrainField",
        "Train a neural field (NeRF-W) on the images of a map, to render views and refine poses.",
    ),
    "render": (
        "field:Render",
        "Render a view of a neural field, or all views of a result, in colour and depth.",
    ),
    "weights": (
        "weights:WeightsCommand",
        "List, fetch, add, convert and check the weights of networks.",
    ),
    "info": ("info:Info", "Say what is in a kapture folder, and what a map allows."),
    "options": (
        "options:OptionsCommand",
        "List the options that --set takes, with value, type and meaning.",
    ),
    "doctor": (
        "doctor:Doctor",
        "Check the environment: versions, known-bad combinations, GPU, weights.",
    ),
}


def command_class(name: str) -> type[Any]:
    """The command of a name; its module is imported."""
    if name in COMMANDS:
        module, _, kind = COMMANDS[name][0].partition(":")
        found: type[Any] = getattr(import_module(f"megloc_kapture.cli.{module}"), kind)
        return found
    from megloc_kapture.cli.outside_stages import stage_command

    return stage_command(name.replace("-", "_"))


def _parser(given: Sequence[str]) -> Any:
    """What tyro parses: the command that is given, or the names of all of them for help."""
    from dataclasses import make_dataclass

    import tyro

    from megloc_kapture.plugins import STAGES, plugin_names

    stages = [name.replace("_", "-") for name in plugin_names(STAGES)]
    annotated: Any = Annotated  # of types that are values here, which mypy does not follow
    completes = given[:1] and given[0].startswith("--tyro-")  # then all that there is
    texts = {name: f"Run the stage {name}, of another package." for name in stages}
    texts |= {name: text for name, (_, text) in COMMANDS.items()}
    entries = []
    for name in [*COMMANDS, *(name for name in stages if name not in COMMANDS)]:
        # a stage that cannot be loaded must not take the other commands with it
        asked = name in given[:1] or (completes and name in COMMANDS)
        kind = command_class(name) if asked else make_dataclass(name.replace("-", "_"), [])
        text = kind.__doc__ if asked and name not in COMMANDS else texts[name]
        entries.append(annotated[kind, tyro.conf.subcommand(name, description=text)])
    return functools.reduce(operator.or_, entries)


def _obey_signals() -> None:
    """End in an orderly way on Ctrl-C and SIGTERM; a second one meanwhile changes nothing."""

    def end(number: int, _frame: object) -> NoReturn:
        _ignore_signals()
        raise KeyboardInterrupt if number == signal.SIGINT else Terminated

    for one in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(one) != signal.SIG_IGN:  # as of what a shell runs in the background
            signal.signal(one, end)


def _ignore_signals() -> None:
    for one in (signal.SIGINT, signal.SIGTERM):
        signal.signal(one, signal.SIG_IGN)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exits with 0, 1 (defect), 2 (user's error), 3, 130 (Ctrl-C) or 143.

    Without arguments it is the console script: those of the process, which signals end in an
    orderly way.
    """
    given = sys.argv[1:] if arguments is None else arguments
    debug = False
    try:
        if arguments is None:
            _obey_signals()
        if list(given) == ["--version"]:
            from megloc_kapture import __version__

            print(f"megloc-kapture {__version__}")
            sys.exit(DONE)
        import tyro

        from megloc_kapture.cli.arguments import one_line_errors

        with one_line_errors(given):
            command: Command = tyro.cli(
                _parser(given), args=given, prog="megloc", config=(tyro.conf.OmitArgPrefixes,)
            )
        debug = command.debug
        status = command.run()
        sys.stdout.flush()
    except MeglocError as error:
        if debug:
            traceback.print_exc()
        for line in error.lines():
            print(f"megloc: {line}", file=sys.stderr)
        status = USER_ERROR
    except KeyboardInterrupt:
        print("megloc: interrupted; run the same command again to go on", file=sys.stderr)
        status = INTERRUPTED
    except Terminated:
        print("megloc: terminated; run the same command again to go on", file=sys.stderr)
        status = TERMINATED
    except ModuleNotFoundError as error:
        if (hint := missing_extra(error)) is None:
            raise
        if debug:
            traceback.print_exc()
        print(f"megloc: {hint}", file=sys.stderr)
        status = USER_ERROR
    except BrokenPipeError:
        # who reads our output has gone; the flush at exit must not complain about it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = DONE
    except OSError as error:
        # closed to us, or too long a name
        if error.filename is None:
            raise
        if debug:
            traceback.print_exc()
        print(f"megloc: {error.filename}: {error.strerror}", file=sys.stderr)
        status = USER_ERROR
    finally:
        if arguments is None:
            _ignore_signals()  # or Python would print tracebacks of its own ending
    sys.exit(status)
