"""Help and errors of the command line: examples behind every page, errors in one line."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator, Sequence

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
megloc densify -i map -o map_with_depth --by patchmatchnet
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
megloc view my_map localized --gt my_scene/query_gt -o view.html --rerun view.rrd
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
        found = [f"megloc {words[0]} -w runs/kapture-classic"]
    narrower = [one for one in found if one.split()[2:3] == words[1:2]]  # of megloc weights fetch
    return "\n".join(["examples:", *(f"  {one}" for one in (narrower or found)[:3])])
