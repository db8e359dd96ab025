"""``megloc``: parse arguments, run a command, and convert errors to messages and exit status.

Heavy modules are imported within :func:`main`, so that Ctrl-C is handled during imports.
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
from typing import Annotated, Any, NoReturn

from megloc_kapture.errors import MeglocError, OptionError, missing_extra, suggestion

DONE, DEFECT, USER_ERROR, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143


class Terminated(BaseException):
    """SIGTERM asks the process to end."""


# name, module:class and first help line, so that only the requested command is imported
_TABLE = """
eval evaluate_dataset:Eval Run all stages on a dataset; stages that are up to date are kept.
import conversion:Import Import a dataset into DIR/{mapping,query,query_gt,megloc}, or a COLMAP \
model as a map.
synth conversion:Synth Render a dataset: a synthetic world as kapture, or a small twin in an \
official layout.
preprocess stages:Preprocess Resize, undistort and mask the images of a kapture folder; cameras \
are adapted.
extract-local stages:ExtractLocal Extract local features of all images of kapture folders.
extract-global retrieval:ExtractGlobal Compute global features of all images: VLAD trained on \
the map, or networks.
pairs-mapping retrieval:PairsMapping Choose pairs of map images to match.
pairs-query retrieval:PairsQuery Choose the map images to match with each query.
match stages:Match Match and verify image pairs; with known poses within a map, else by a two-view \
model.
triangulate stages:Triangulate Triangulate verified matches of images with known poses into a \
kapture map.
refine-map maps:RefineMap Remove points and observations that a map's images or depth maps \
contradict.
densify maps:Densify Estimate depth of map images without depth, by multi-view stereo.
refine-poses maps:RefinePoses Refine the poses of localized queries; a pose that does not \
improve is kept, with the reason.
map maps:MapPhotographs Make a map of photographs without poses; stages that are up to date are \
kept.
localize localize:Localize Localize photographs, or the images of a kapture folder, in a kapture \
map.
serve localize:Serve Localize images sent over HTTP in a kapture map; has a page for \
photographs.
submit evaluate:Submit Write the pose file of a localized kapture folder, and a JSON file with \
its provenance.
check evaluate:Check Check a pose file of any tool against the rules of its challenge and the \
map.
evaluate evaluate:Evaluate Compare localized queries (kapture folders, pose files, COLMAP models) \
with their true poses, and two or more results with each other.
export conversion:Export Write a map, localized queries or both for COLMAP, nerfstudio, evo and \
viewers.
view conversion:View Write a page that shows a map and localized queries in 3D; it works offline.
train training:Train Train SuperGlue, or a detector's descriptors, on kapture folders with depth \
and on photographs.
train-field training:TrainField Train a neural field (NeRF-W) on the images of a map, to render \
views and refine poses.
render training:Render Render views of a neural field: at a pose, along a result, or between map \
cameras.
weights weights:WeightsCommand List, fetch, add, convert and check the weights of networks.
info info:Info Describe a kapture folder, and how it can be used as a map.
options info:OptionsCommand List the options that --set takes, with value, type and meaning.
doctor weights:Doctor Check the environment: versions, known-bad combinations, GPU, weights.
"""
COMMANDS: dict[str, tuple[str, str]] = {
    name: (place, text)
    for name, place, text in (line.split(" ", 2) for line in _TABLE.strip().splitlines())
}


def command_class(name: str) -> type[Any]:
    if name in COMMANDS:
        module, _, kind = COMMANDS[name][0].partition(":")
        found: type[Any] = getattr(import_module(f"megloc_kapture.cli.{module}"), kind)
        return found
    from megloc_kapture.cli.stages import stage_command

    return stage_command(name.replace("-", "_"))


def _parser(given: Sequence[str]) -> Any:
    """Return the type that tyro parses; only the given command has flags."""
    from dataclasses import make_dataclass

    import tyro

    from megloc_kapture.plugin_names import STAGES, plugin_names

    stages = [name.replace("_", "-") for name in plugin_names(STAGES)]
    if given and not given[0].startswith("-") and given[0] not in [*COMMANDS, *stages]:
        known = suggestion(given[0], [*COMMANDS, *stages], listed="commands: ")
        raise OptionError(f"unknown command {given[0]!r}; {known}")
    annotated: Any = Annotated  # of runtime types, which mypy does not follow
    completes = given[:1] and given[0].startswith("--tyro-")  # shell completion needs all commands
    texts = {name: f"Run the stage {name}, of another package." for name in stages}
    texts |= {name: text for name, (_, text) in COMMANDS.items()}
    commands = []
    for name in [*COMMANDS, *(name for name in stages if name not in COMMANDS)]:
        # a stage that fails to load must not break other commands
        asked = name in given[:1] or (completes and name in COMMANDS)
        kind = command_class(name) if asked else make_dataclass(name.replace("-", "_"), [])
        text = kind.__doc__ if asked and name not in COMMANDS else texts[name]
        commands.append(annotated[kind, tyro.conf.subcommand(name, description=text)])
    return functools.reduce(operator.or_, commands)


def _terminate(number: int, frame: object) -> NoReturn:
    raise Terminated


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exit with 0, 1 (defect), 2 (user's error), 3, 130 (Ctrl-C) or 143.

    ``arguments`` default to those of the process.
    """
    given = sys.argv[1:] if arguments is None else arguments
    debug = False
    try:
        if arguments is None:
            signal.signal(signal.SIGTERM, _terminate)
        if list(given) == ["--version"]:
            from megloc_kapture import __version__

            print(f"megloc-kapture {__version__}")
            sys.exit(DONE)
        import tyro

        command = tyro.cli(
            _parser(given), args=given, prog="megloc", config=(tyro.conf.OmitArgPrefixes,)
        )
        debug = command.debug
        status = command.run(command.console()) or DONE
        sys.stdout.flush()
    except (KeyboardInterrupt, Terminated) as error:
        terminated = isinstance(error, Terminated)
        status = TERMINATED if terminated else INTERRUPTED
        how = "terminated" if terminated else "interrupted"
        print(f"megloc: {how}; run the same command again to go on", file=sys.stderr)
    except Exception as error:
        status = _tell(error, debug)
    sys.exit(status)


def _tell(error: BaseException, debug: bool) -> int:
    """Print a user error, a line each, and return the exit status; reraise internal errors."""
    if isinstance(error, BrokenPipeError):
        # our reader has gone; the flush at exit must not complain
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    if isinstance(error, MeglocError):
        lines = error.lines()
    elif isinstance(error, ModuleNotFoundError) and (hint := missing_extra(error)) is not None:
        lines = [hint]
    elif isinstance(error, OSError) and error.filename is not None:
        lines = [f"{error.filename}: {error.strerror}"]  # unreadable file, or name too long
    else:
        raise error
    if debug:
        traceback.print_exception(error)
    for line in lines:
        print(f"megloc: {line}", file=sys.stderr)
    return USER_ERROR
