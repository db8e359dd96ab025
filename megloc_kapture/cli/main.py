"""``megloc``: parse, run, and turn errors into one line and an exit status.

Examples stand behind every page of help, and what is wrong with arguments is said in one line.

Heavy modules are imported within :func:`main`, where Ctrl-C is met by one line as well.
"""

from __future__ import annotations

import contextlib
import functools
import io
import operator
import os
import re
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, Protocol

from megloc_kapture.errors import MeglocError, missing_extra

if TYPE_CHECKING:
    from megloc_kapture.cli.common import Console

DONE, DEFECT, USER_ERROR, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_RULE = re.compile(r"[─-]{3,}")
# what the box says besides: where help is found, and the help itself
_BESIDES = ("For full helptext", "Argument helptext", "Perhaps you meant", "Got errors")
# help of a flag stands two steps in, its name one
_HELP_INDENT = " " * 8


class Terminated(BaseException):
    """SIGTERM asks the process to end."""


class Command(Protocol):
    """A command: its flags are its fields."""

    debug: bool

    def console(self) -> Console:
        """The console that the flags ask for."""
        ...

    def run(self, console: Console) -> int | None:
        """Run it; returns the exit status, nothing where all went well."""
        ...


# name, module and class, first line of the help: only the command that runs is imported
_TABLE = """
eval evaluate_dataset:Eval Run all stages on a dataset; what is done and still true is kept.
import conversion:Import Bring a dataset into DIR/{mapping,query,query_gt,megloc}, or a COLMAP \
model into a map.
synth conversion:Synth Render a dataset: the synthetic world as kapture, or a small twin in an \
official layout.
preprocess stages:Preprocess Resize, undistort and mask the images of a kapture; poses stay, \
cameras follow.
extract-local stages:ExtractLocal Extract local features of all images of kapture folders.
extract-global retrieval:ExtractGlobal Describe every image by one vector: VLAD trained on the \
map, or image networks.
pairs-mapping retrieval:PairsMapping Choose which images of a map are matched with each other.
pairs-query retrieval:PairsQuery Choose the map images each query is matched with.
match stages:Match Match and verify image pairs; with known poses within a map, else by a two-view \
model.
triangulate stages:Triangulate Triangulate verified matches of images with known poses into a \
kapture map.
refine-map maps:RefineMap Take points and observations out of a map that its images, or depth \
maps, contradict.
densify maps:Densify Estimate depth of a map's images that have none, by multi-view stereo.
refine-poses maps:RefinePoses Refine the poses of localized queries; a pose that gets no better \
stays, and says why.
map maps:MapPhotographs Make a map of photographs without poses; what is done and still true is \
kept.
localize localize:Localize Localize photographs, or the images of a kapture folder, in a kapture \
map.
serve localize:Serve Localize images that come by HTTP in a kapture map; with a page for \
photographs.
submit evaluate:Submit Write the pose file of a localized kapture folder, and its provenance \
beside it.
check evaluate:Check Check a pose file, ours or foreign, against the rules of its challenge and \
the map.
evaluate evaluate:Evaluate Compare localized queries (kapture folders, pose files, COLMAP models) \
with their true poses, and two or more results with each other.
export conversion:Export Write a map, localized queries or both for COLMAP, nerfstudio, evo and \
viewers.
view conversion:View Write a page that shows a map in 3D, and the queries of a result in it; it \
needs no network.
train training:Train Train SuperGlue, or a detector's descriptors, on kapture folders with depth \
and on photographs.
train-field training:TrainField Train a neural field (NeRF-W) on the images of a map, to render \
views and refine poses.
render training:Render Render a view of a neural field, views of a result, or views that no camera \
took.
weights weights:WeightsCommand List, fetch, add, convert and check the weights of networks.
info info:Info Say what is in a kapture folder, and what a map allows.
options info:OptionsCommand List the options that --set takes, with value, type and meaning.
doctor weights:Doctor Check the environment: versions, known-bad combinations, GPU, weights.
"""
COMMANDS: dict[str, tuple[str, str]] = {
    name: (place, text)
    for name, place, text in (line.split(" ", 2) for line in _TABLE.strip().splitlines())
}


def command_class(name: str) -> type[Any]:
    """The command of a name; its module is imported."""
    if name in COMMANDS:
        module, _, kind = COMMANDS[name][0].partition(":")
        found: type[Any] = getattr(import_module(f"megloc_kapture.cli.{module}"), kind)
        return found
    from megloc_kapture.cli.stages import stage_command

    return stage_command(name.replace("-", "_"))


def _parser(given: Sequence[str]) -> Any:
    """What tyro parses: the command that is given, or the names of all of them for help."""
    from dataclasses import make_dataclass

    import tyro

    from megloc_kapture.plugin_loading import plugin_names
    from megloc_kapture.plugins import STAGES

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
            print(f"megloc: {summary(drawn.getvalue())}{_did_you_mean(arguments)}", file=sys.stderr)
        elif asks_help:
            print(examples_text(arguments))
        raise
    print(drawn.getvalue(), end="", file=sys.stderr)


def _did_you_mean(arguments: Sequence[str]) -> str:
    """A suggestion for a misspelt command or flag; empty where none is close."""
    if not arguments or arguments[0] not in COMMANDS:
        words, known = list(arguments[:1]), list(COMMANDS)
    else:
        names = getattr(command_class(arguments[0]), "__dataclass_fields__", {})
        known = [f"--{name.replace('_', '-')}" for name in names]
        words = [word.split("=")[0] for word in arguments if word.startswith("--")]
    unknown = [word for word in words if word not in known]
    close = [match for word in unknown for match in get_close_matches(word, known, n=1)]
    return f"; did you mean {' '.join(close)}?" if close else ""


def summary(drawn: str) -> str:
    """The text of a drawn box without its frame and what stands in it besides, on one line."""
    drawn = drawn.replace("__tyro-dummy-inner__.", "")  # tyro's own name of our command
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


_TEXT = """
megloc map photos/ -o my_map
megloc map photos/ walk.mp4 -o my_map --scale a.jpg b.jpg 2.35
megloc localize -i my_map --images IMG_0001.jpg holiday/ walk.mp4 -o localized
megloc localize -i my_map --query my_scene/query -o localized
megloc eval kapture --root my_scene
megloc eval kapture --root my_scene --set localization.pose.max_error_px=8 --dry-run
megloc eval aachen --root /data/Aachen-Day-Night --executor dask --scheduler tcp://host:8786
megloc import aachen /data/Aachen-Day-Night -o aachen
megloc import colmap sparse/0 --images photos --database features.db -o my_map
megloc synth -o my_scene
megloc synth aachen -o twin --seed 1
megloc preprocess -i my_scene/mapping -o smaller --resize 1600 --undistort
megloc preprocess -i my_scene/mapping -o masked --segmenter deeplabv3plus --unchanging
megloc extract-local -i my_scene/mapping -i my_scene/query -o features
megloc extract-local -i my_scene/mapping --features aliked xfeat -o features
megloc extract-global -i my_scene/mapping --query my_scene/query --features-dir features -o features
megloc pairs-mapping -i my_scene/mapping --by poses -o pairs_mapping.txt
megloc pairs-mapping -i my_scene/mapping --by retrieval --features-dir features -o pairs_mapping.txt
megloc pairs-query -i my_scene/mapping --query my_scene/query --features-dir features -o pairs.txt
megloc match -i my_scene/mapping --features-dir features --pairs pairs_mapping.txt -o matches
megloc match -i my_scene/mapping --query my_scene/query --features-dir features --pairs pairs.txt \
-o matches
megloc triangulate -i my_scene/mapping --features-dir features --features-dir matches -o map
megloc densify -i map -o map_with_depth --fuse cloud.ply
megloc densify -i map -o map_with_depth --by sweep
megloc refine-map -i map -o map_refined --set refinement.uncertainty.max_robust_sigmas=2.5
megloc refine-poses -i map --query my_scene/query --poses localized -o refined --by icp
megloc train matcher -i my_scene/mapping --held-out other_scene/mapping -o matcher.safetensors
megloc train descriptor -i my_scene/mapping --features xfeat -o descriptor.safetensors
megloc serve my_map
megloc serve my_map --host 0.0.0.0 --token-file token.txt --workers 2
megloc submit aachen -i runs/aachen-megloc/localized -o poses.txt
megloc check aachen poses.txt --data runs/aachen-megloc
megloc evaluate -i localized --gt my_scene/query_gt -o evaluation
megloc evaluate -i localized -i refined --gt my_scene/query_gt
megloc export colmap -i my_map --query localized -o sparse/0
megloc export tum --query localized -o localized.tum
megloc view my_map --open
megloc view my_map localized --gt my_scene/query_gt -o view.html
megloc train-field -i my_scene/mapping -o field --minutes 15
megloc render field --pose 1,0,0,0,0.2,0,1.5 --camera SIMPLE_PINHOLE,320,240,260,160,120 -o view.png
megloc render field --along localized -o rendered
megloc weights list
megloc weights fetch --preset modern
megloc weights add superpoint_v1.pth
megloc info my_map
megloc options localization.pose
megloc options aliked --preset modern
megloc doctor
"""
EXAMPLES = tuple(_TEXT.strip().splitlines())


def examples_text(arguments: Sequence[str]) -> str:
    """The end of the help page that these arguments ask for."""
    words = [word for word in arguments if not word.startswith("-")]
    found = [one for one in EXAMPLES if one.split()[1] in (words[:1] or ("localize", "eval"))]
    if not found:  # the command of a stage of another package
        found = [f"megloc {words[0]} -w runs/kapture-my_scene-classic"]
    narrower = [one for one in found if one.split()[2:3] == words[1:2]]  # of megloc weights fetch
    return "\n".join(["examples:", *(f"  {one}" for one in (narrower or found)[:3])])


def _terminate(number: int, frame: object) -> NoReturn:
    raise Terminated


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exits with 0, 1 (defect), 2 (user's error), 3, 130 (Ctrl-C) or 143.

    Without arguments it is the console script, which takes those of the process.
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

        with one_line_errors(given):
            command: Command = tyro.cli(
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
    """Tell the user's errors in a line each, and the exit status; raises again what is a defect."""
    if isinstance(error, BrokenPipeError):
        # who reads our output has gone; the flush at exit must not complain about it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    if isinstance(error, MeglocError):
        lines = error.lines()
    elif isinstance(error, ModuleNotFoundError) and (hint := missing_extra(error)) is not None:
        lines = [hint]
    elif isinstance(error, OSError) and error.filename is not None:
        lines = [f"{error.filename}: {error.strerror}"]  # closed to us, or too long a name
    else:
        raise error
    if debug:
        traceback.print_exception(error)
    for line in lines:
        print(f"megloc: {line}", file=sys.stderr)
    return USER_ERROR
