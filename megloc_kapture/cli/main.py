"""``megloc``: parse arguments, run a command, and convert errors to messages and exit status.

Heavy modules are imported within :func:`main`, so that Ctrl-C is handled during imports.
"""

from __future__ import annotations

import ast
import errno
import functools
import operator
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

from megloc_kapture.errors import MeglocError, OptionError, missing_extra, suggestion

# an internal error exits with 1
DONE, USER_ERROR, INTERRUPTED, TERMINATED = 0, 2, 130, 143


# command -> "module:class", so that only the module of the requested command is imported
COMMANDS = {
    "eval": "evaluate_dataset:Eval",
    "import": "conversion:Import",
    "synth": "conversion:Synth",
    "preprocess": "stages:Preprocess",
    "extract-local": "stages:ExtractLocal",
    "extract-global": "stages:ExtractGlobal",
    "pairs-mapping": "stages:PairsMapping",
    "pairs-query": "stages:PairsQuery",
    "match": "stages:Match",
    "triangulate": "stages:Triangulate",
    "refine-map": "maps:RefineMap",
    "densify": "maps:Densify",
    "refine-poses": "maps:RefinePoses",
    "map": "maps:MapPhotographs",
    "localize": "localize:Localize",
    "serve": "localize:Serve",
    "submit": "evaluate:Submit",
    "check": "evaluate:Check",
    "evaluate": "evaluate:Evaluate",
    "export": "conversion:Export",
    "view": "conversion:View",
    "train": "training:Train",
    "train-field": "training:TrainField",
    "render": "training:Render",
    "weights": "weights:WeightsCommand",
    "info": "info:Info",
    "options": "info:OptionsCommand",
    "doctor": "weights:Doctor",
}
_RESUMING = ("eval", "map", "train", "train-field")  # the others start over


def _help_texts() -> dict[str, str]:
    """Return the first paragraph of each command's docstring, without importing its module."""
    folder = Path(__file__).parent
    modules = {place.partition(":")[0] for place in COMMANDS.values()}
    classes = {
        f"{module}:{node.name}": (ast.get_docstring(node) or "").partition("\n\n")[0]
        for module in modules
        for node in ast.parse((folder / f"{module}.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    }
    return {name: " ".join(classes[place].split()) for name, place in COMMANDS.items()}


def command_class(name: str) -> type[Any]:
    if name in COMMANDS:
        module, _, kind = COMMANDS[name].partition(":")
        command: type[Any] = getattr(import_module(f"megloc_kapture.cli.{module}"), kind)
        return command
    from megloc_kapture.cli.stages import stage_command
    from megloc_kapture.plugin_names import STAGES, plugin_names

    return stage_command(next(n for n in plugin_names(STAGES) if n.replace("_", "-") == name))


def _parser(given: Sequence[str]) -> Any:
    """Return the type that tyro parses; only the command that ``given`` names gets its flags."""
    from dataclasses import make_dataclass

    import tyro

    from megloc_kapture.plugin_names import STAGES, plugin_names

    texts = _help_texts()
    for stage in (name.replace("_", "-") for name in plugin_names(STAGES)):
        texts.setdefault(stage, f"Run the stage {stage} of a third-party package.")
    if given and not given[0].startswith("-") and given[0] not in texts:
        known = suggestion(given[0], texts, listed="commands: ")
        raise OptionError(f"unknown command {given[0]!r}; {known}")
    annotated: Any = Annotated  # mypy does not follow runtime types
    completes = given[:1] and given[0].startswith("--tyro-")  # shell completion needs all commands
    commands = []
    for name, text in texts.items():
        # a stage that fails to load must not break other commands
        asked = name in given[:1] or (completes and name in COMMANDS)
        kind = command_class(name) if asked else make_dataclass(name.replace("-", "_"), [])
        shown = kind.__doc__ if asked and name not in COMMANDS else text
        commands.append(annotated[kind, tyro.conf.subcommand(name, description=shown)])
    return functools.reduce(operator.or_, commands)


def _say_stopped(how: str, given: Sequence[str]) -> None:
    resumes = given[:1] and given[0] in _RESUMING
    remedy = "; run the same command again to resume" if resumes else ""
    print(f"megloc: {how}{remedy}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit with its status; ``arguments`` default to those of the process.

    0 means success, 1 an internal error, 2 a user error, 3 a recall below ``eval --fail-below``,
    130 Ctrl-C and 143 SIGTERM.
    """
    given = sys.argv[1:] if arguments is None else arguments
    debug = False
    try:
        if arguments is None:
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
            # matplotlib fails to load if a notebook's backend is not in this environment
            os.environ["MPLBACKEND"] = "agg"
        if list(given) == ["--version"]:
            from megloc_kapture import __version__

            print(f"megloc-kapture {__version__}")
            sys.exit(DONE)
        import tyro

        if isinstance(sys.stdout, TextIOWrapper):
            # print results at once, even to a pipe; escape what the terminal cannot print
            sys.stdout.reconfigure(line_buffering=True, errors="backslashreplace")
        command = tyro.cli(
            _parser(given), args=given, prog="megloc", config=(tyro.conf.OmitArgPrefixes,)
        )
        command = getattr(command, "action", command)  # subcommand of `megloc weights`
        debug = command.debug
        command.start_logging()
        status = command.run() or DONE
        sys.stdout.flush()
    except KeyboardInterrupt:
        _say_stopped("interrupted", given)
        status = INTERRUPTED
    except SystemExit as end:
        # not printed by the signal handler, which may have interrupted another print
        if end.code == TERMINATED:
            _say_stopped("terminated", given)
        raise
    except Exception as error:
        status = _tell(error, debug)
    sys.exit(status)


def _tell(error: BaseException, debug: bool) -> int:
    """Print the lines of a user error and return the exit status; reraise internal errors."""
    if isinstance(error, BrokenPipeError):
        # the flush of standard output at exit must not raise the error again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    if isinstance(error, MeglocError):
        lines = error.lines()
    elif isinstance(error, ModuleNotFoundError) and (hint := missing_extra(error)) is not None:
        lines = [hint]
    elif isinstance(error, OSError) and error.filename is not None:
        lines = [f"{error.filename}: {error.strerror}"]  # unreadable file, or name too long
    elif isinstance(error, OSError) and error.errno == errno.ENOSPC:
        lines = [f"{error.strerror}: free some in the output or the temporary folder (TMPDIR)"]
    else:
        raise error
    if debug:
        traceback.print_exception(error)
    for line in lines:
        print(f"megloc: {line}", file=sys.stderr)
    return USER_ERROR
