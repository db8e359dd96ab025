"""Run stages in order, without those that are up to date."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from numbers import Integral
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from megloc_kapture.errors import (
    DataError,
    OptionError,
    OutputError,
    PluginError,
    check_option,
    suggestion,
)
from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.io.files import (
    clear_temporary,
    read_json_model,
    remove,
    write_bytes,
    write_json_model,
    writing,
)
from megloc_kapture.io.output_folders import claim_folder, release_folder
from megloc_kapture.stages.paths import MAP
from megloc_kapture.stages.stage import (
    CODE_OF,
    PROTOCOL,
    ROOT,
    Stage,
    StageWork,
    counts_text,
    is_below,
)
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Options

PARTIAL = ".partial"
LOCK = ".lock"
MARK = ".fingerprint"  # in the unfinished output folder of a stage that resumes


def map_of_workspace(path: Path) -> Path:
    """Return the kapture map in a workspace; any other path unchanged."""
    is_workspace = (path / LOCK).is_file() and (path / MAP).is_dir()
    return path / MAP if is_workspace else path


class Workspace:
    """Paths, lock and output folders of a workspace (docs/architecture.md)."""

    def __init__(self, root: Path, *, force: bool = False) -> None:
        self.root, self.force = Path(root).absolute(), force
        self._is_new = claim_folder(self.root, kind="workspace", force=force)
        self._published = False

    def path(self, relative: str) -> Path:
        return self.root / relative

    def manifest_path(self, stage: str) -> Path:
        return self.root / "stages" / f"{stage}.json"

    def manifest(self, stage: str) -> Manifest | None:
        return read_manifest(self.manifest_path(stage))

    def partial_path(self, stage: str) -> Path:
        """Return the folder of a stage's unfinished output."""
        return self.root / PARTIAL / stage

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the workspace for this process.

        First remove leftovers of killed runs, except items of stages that resume. At the end remove
        the workspace if it has neither finished nor unfinished output.
        """
        path = self.root / LOCK
        with writing(path):
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise OutputError(
                    f"{self.root}: another run is using this workspace; wait for it or use "
                    "another workspace"
                ) from error
            self._clear_partial()
            for folder in (self.root, self.root / "stages"):
                clear_temporary(folder, nested=False)
            try:
                yield
            finally:
                self._clear_partial()
                self._remove_if_unused()
        finally:
            os.close(handle)

    def _clear_partial(self) -> None:
        for folder in (self.root / PARTIAL).glob("*"):
            if not (folder / MARK).is_file():
                with contextlib.suppress(OSError):
                    remove(folder)

    def _remove_if_unused(self) -> None:
        stopped = any((self.root / PARTIAL).glob("*"))
        if self._published or stopped or (self.root / "stages").is_dir():
            return
        with contextlib.suppress(OSError):
            (self.root / LOCK).unlink(missing_ok=True)
            (self.root / PARTIAL).rmdir()
        if self._is_new:
            release_folder(self.root)

    @contextmanager
    def staging(self, stage: str, mark: str, *, resumes: bool = False) -> Iterator[Path]:
        """Yield the folder to write a stage's output into; remove it at the end.

        If a stage that ``resumes`` fails, its items are kept, so that a run with the same ``mark``
        (the stage's fingerprint) can continue.
        """
        place = self.partial_path(stage)
        with writing(place):
            if not (place / MARK).is_file() or (place / MARK).read_text() != mark:
                remove(place)
            place.mkdir(parents=True, exist_ok=True)
            if resumes:
                write_bytes(place / MARK, mark.encode())
        done = False
        try:
            yield place
            done = True
        finally:
            has_items = any(entry.name != MARK for entry in place.glob("*"))
            if done or not (resumes and has_items):
                with contextlib.suppress(OSError):
                    remove(place)

    def publish(self, staging: Path, outputs: tuple[str, ...]) -> None:
        """Move a stage's outputs into place, and remove old outputs that were not written again."""
        self._published = True
        for output in outputs:
            new, place = staging / output, self.root / output
            with writing(place):
                place.parent.mkdir(parents=True, exist_ok=True)
                remove(place)
                if new.exists():
                    os.rename(new, place)


class Manifest(Options):
    stage: str
    version: int
    options: dict[str, Any]
    inputs: dict[str, str] = Field(description="fingerprints of the inputs by name")
    fingerprint: str
    output: str = Field(description="fingerprint of the outputs, for stages that read them")
    outputs: tuple[str, ...]
    counts: dict[str, int | float] = Field(default_factory=dict)
    seconds: float
    started: str
    versions: dict[str, str]


def fingerprint(stage: str, version: int, options: dict[str, Any], inputs: dict[str, str]) -> str:
    content = {"stage": stage, "version": version, "options": options, "inputs": inputs}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def read_manifest(path: Path) -> Manifest | None:
    """Read a manifest; None if missing or broken, so that the stage runs again."""
    try:
        return read_json_model(path, Manifest)
    except DataError:
        return None


def read_manifests(workspace: Path) -> dict[str, Manifest]:
    """Return the readable manifests of a workspace by stage."""
    manifests = map(read_manifest, sorted((workspace / "stages").glob("[!.]*.json")))
    return {manifest.stage: manifest for manifest in manifests if manifest is not None}


State = Literal["run", "kept", "pending", "skipped"]
_NOT_DONE = "not done yet"


@dataclass(frozen=True)
class StageReport:
    name: str
    state: State
    seconds: float
    counts: Mapping[str, float]
    why: str


def run_plan(
    stages: Sequence[Stage],
    workspace: Workspace,
    work: Work = HERE,
    *,
    first: str | None = None,
    last: str | None = None,
    dry_run: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> list[StageReport]:
    """Run the stages that are out of date, or report them in a ``dry_run``.

    The stage ``first`` and its dependents run again; stages before it are skipped and their outputs
    used as they are. Stages after ``last`` do not run. ``say`` receives a line when a stage starts,
    with the reason, and a line when it ends.
    """
    names = [stage.name for stage in stages]
    for name in (first, last):
        if name is not None and name not in names:
            raise OptionError(f"no stage {name!r}; {suggestion(name, names, listed='stages: ')}")
    start = names.index(first) if first else 0
    stop = names.index(last) + 1 if last else len(names)
    check_option(stop > start, f"--until {last} comes before --from {first}")
    asked = _with_followers(stages, first) if first else {}
    for name in names[:start]:
        if workspace.manifest(name) is None:
            raise OptionError(f"--from {first} needs stage {name}, which has not run; omit --from")
    for stage in stages:
        if not isinstance(stage, Stage):
            base = f"{Stage.__module__}.{Stage.__name__}"
            raise PluginError(f"stage plugin {stage.name!r} is not derived from {base}")
        _check_root(stage, workspace)
    if not dry_run:
        # before any stage runs, so that the next run still repeats these stages if this one stops
        for name in asked:
            workspace.manifest_path(name).unlink(missing_ok=True)
            remove(workspace.partial_path(name))
    marks: dict[str, str] = {}  # stage -> fingerprint of its output
    reports = []
    for number, stage in enumerate(stages[:stop]):
        inputs = {name: marks[name] for name in _before(stages, stage)}
        inputs |= _earlier_inputs(stages, stage, workspace) | dict(stage.external()) | stage.code()
        made = workspace.manifest(stage.name)
        planned = _planned(stage, inputs)
        why = asked.get(stage.name) or _why(stage, planned, made, workspace)
        state: State
        if made is not None and (number < start or not why):
            state, manifest = "skipped" if number < start else "kept", made
        elif dry_run:
            stage.check()
            state, manifest = "pending", planned
        else:
            reason = "starting" if why == _NOT_DONE else why
            say(f"{stage.name}, stage {number + 1} of {stop}: {reason}")
            state, manifest = "run", _run(stage, planned, made, workspace, work)
        marks[stage.name] = manifest.output
        reports.append(StageReport(stage.name, state, manifest.seconds, manifest.counts, why))
        say(describe(reports[-1]))
    return reports


def _planned(stage: Stage, inputs: dict[str, str]) -> Manifest:
    """Return the manifest that a run of the stage would have, without results."""
    settings = json.loads(json.dumps(stage.settings(), default=str))  # converts tuples to lists
    # stages that read the outputs do not depend on the dataset's path and protocol
    options = {name: value for name, value in settings.items() if name != PROTOCOL}
    content = {name: mark for name, mark in inputs.items() if name != ROOT}
    return Manifest(
        stage=stage.name,
        version=stage.version,
        options=settings,
        inputs=inputs,
        fingerprint=fingerprint(stage.name, stage.version, settings, inputs),
        output=fingerprint(stage.name, stage.version, options, content),
        outputs=(),
        seconds=0.0,
        started="",
        versions={},
    )


def _former_outputs(stage: Stage, made: Manifest | None) -> list[str]:
    return [] if made is None else sorted(set(made.outputs) - set(stage.writes))


def _why(stage: Stage, planned: Manifest, made: Manifest | None, workspace: Workspace) -> str:
    """Return the reason to run a stage, or "" if its results are up to date."""
    if made is None:
        return _NOT_DONE
    gone = [output for output in made.outputs if not workspace.path(output).exists()]
    if gone:
        return f"{gone[0]} is missing"
    if before := _former_outputs(stage, made):
        return f"{before[0]} is no longer written"
    if made.fingerprint == planned.fingerprint:
        return ""
    if made.version != planned.version:
        return "a newer version of the stage"
    changed = _differences(made.inputs, planned.inputs)
    # report a changed option rather than changed plugin code
    read = [name for name in changed if not name.startswith(CODE_OF)]
    options = _differences(made.options, planned.options)
    if options and not read:
        return f"options changed: {', '.join(options[:3])}"
    return f"{(read or changed)[0]} changed"


def _before(stages: Sequence[Stage], stage: Stage) -> list[str]:
    earlier = stages[: stages.index(stage)]
    return [
        other.name
        for other in earlier
        if any(is_below(path, *other.writes) for path in stage.reads)
    ]


def _earlier_inputs(stages: Sequence[Stage], stage: Stage, workspace: Workspace) -> dict[str, str]:
    """Return fingerprints, by stage, of inputs written by stages that are not in this plan."""
    written = [path for other in stages for path in other.writes]
    missing = [path for path in stage.reads if not is_below(path, *written)]
    if not missing:
        return {}
    manifests = read_manifests(workspace.root).values()
    outputs = {}
    for path in missing:
        made = [manifest for manifest in manifests if is_below(path, *manifest.outputs)]
        check_option(
            made, f"stage {stage.name} reads {path}, which no stage has written in {workspace.root}"
        )
        outputs.update({manifest.stage: manifest.output for manifest in made})
    return outputs


def _check_root(stage: Stage, workspace: Workspace) -> None:
    """Raise OptionError if the results are from another root that still exists."""
    made = workspace.manifest(stage.name)
    held = "" if made is None else made.inputs.get(ROOT, "")
    if workspace.force or not held or not Path(held).is_dir():
        return
    if stage.root is None or str(stage.root.resolve()) != held:
        raise OptionError(
            f"{workspace.root} was made from {held}; give another folder for "
            f"{stage.root or 'other data'}, or --force to replace its content"
        )


def _with_followers(stages: Sequence[Stage], first: str) -> dict[str, str]:
    reasons = {first: "requested"}
    for stage in stages:
        if not reasons.keys().isdisjoint(_before(stages, stage)):
            reasons[stage.name] = f"follows {first}"
    return reasons


def _take_over(stage: Stage, workspace: Workspace) -> None:
    for name, other in read_manifests(workspace.root).items():
        if name != stage.name and not set(other.outputs).isdisjoint(stage.writes):
            workspace.manifest_path(name).unlink(missing_ok=True)


def _differences(old: Any, new: Any, prefix: str = "") -> list[str]:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        differences: list[str] = []
        for key in sorted(set(old) | set(new)):
            name = f"{prefix}.{key}" if prefix else key
            differences += _differences(old.get(key, "absent"), new.get(key, "absent"), name)
        return differences
    # as in fingerprints, in which 1 and 1.0 differ
    return [] if json.dumps(old, sort_keys=True) == json.dumps(new, sort_keys=True) else [prefix]


def _run(
    stage: Stage, planned: Manifest, made: Manifest | None, workspace: Workspace, work: Work
) -> Manifest:
    started = datetime.now(UTC).isoformat(timespec="seconds")
    clock = time.perf_counter()
    with workspace.staging(stage.name, planned.fingerprint, resumes=stage.resumes) as folder:
        resumed = replace(work, resume=stage.resumes, placement=stage.placement)
        counted = stage.run(StageWork(**vars(resumed), root=workspace.root, out=folder)) or {}
        # plugins may count with numpy
        counts = {n: int(v) if isinstance(v, Integral) else float(v) for n, v in counted.items()}
        clear_temporary(folder)
        # if killed below this line, the stage has no manifest and runs again
        workspace.manifest_path(stage.name).unlink(missing_ok=True)
        _take_over(stage, workspace)
        written = tuple(o for o in stage.writes if (folder / o).exists())
        workspace.publish(folder, (*stage.writes, *_former_outputs(stage, made)))
    results = {
        "outputs": written,
        "counts": counts,
        "seconds": round(time.perf_counter() - clock, 3),
        "started": started,
        "versions": package_versions(),
    }
    manifest = planned.model_copy(update=results)
    write_json_model(workspace.manifest_path(stage.name), manifest)
    return manifest


def all_kept(reports: Iterable[StageReport]) -> bool:
    return all(report.state in ("kept", "skipped") for report in reports)


def describe(report: StageReport) -> str:
    if report.state == "kept":
        return f"{report.name}: up to date"
    if report.state == "skipped":
        return f"{report.name}: used as is" + (f" ({report.why})" if report.why else "")
    if report.state == "pending":
        return f"{report.name}: would run ({report.why})"
    parts = filter(None, (counts_text(report.counts), f"{report.seconds:.1f} s"))
    return f"{report.name}: {'; '.join(parts)}"
