"""A plan: stages in order, each run only when it has to be."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal

from megloc_kapture.errors import OptionError, suggestion
from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.io.files import clear_temporary, hard_link, write_bytes, write_json_model
from megloc_kapture.pipeline.workspace import (
    HASHES,
    JOURNAL,
    FileHashes,
    Manifest,
    Workspace,
    changed_file,
    fingerprint,
    read_manifest,
    remember_files,
    written_files,
)
from megloc_kapture.stages.stage import CODE_OF, ROOT, Stage, StageWork, count_text, is_below
from megloc_kapture.stages.work import HERE, Digest, KeptItems, Work

State = Literal["run", "kept", "pending", "skipped"]
_NOT_DONE = "not done yet"


@dataclass(frozen=True)
class StageReport:
    """What happened to a stage, for the one who prints."""

    name: str
    state: State
    seconds: float
    counts: Mapping[str, float]
    why: str
    kept_items: str = ""  # how many of its items were taken over from runs before


def run_plan(
    stages: Sequence[Stage],
    workspace: Workspace,
    work: Work = HERE,
    *,
    first: str | None = None,
    last: str | None = None,
    dry_run: bool = False,
    verify: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> list[StageReport]:
    """Run the stages that have to be run.

    A stage runs behind those that write what it reads.

    Parameters
    ----------
    first : stages before it are taken as they are; it and all that reads its output, directly or
        not, is run again in any case.
    last : stages behind it are left out.
    dry_run : say what would run, run nothing.
    say : told in one line which stage starts, and why it has to run; and what it came to.
    verify : compare the content of all files that stages wrote with what it was then; otherwise
        their sizes and times alone.

    Raises
    ------
    OptionError : ``first`` or ``last`` is no stage, or ``first`` needs a stage that has not run; or
        the workspace holds data of another root, and was opened without ``force``.
    """
    names = [stage.name for stage in stages]
    for name in (first, last):
        if name is not None and name not in names:
            raise OptionError(f"no stage {name!r}; {suggestion(name, names, listed='stages: ')}")
    start = names.index(first) if first else 0
    stop = names.index(last) + 1 if last else len(names)
    if stop <= start:
        raise OptionError(f"--until {last} stands before --from {first}")
    asked = _with_followers(stages, first) if first else {}
    for name in names[:start]:
        if workspace.manifest(name) is None:
            raise OptionError(
                f"--from {first} needs stage {name}, which has not run; leave --from out"
            )
    for stage in stages:
        _check_root(stage, workspace)
    external = _external(stages, workspace)
    if not dry_run:
        # whatever stops this run, the next one has to do what was asked for
        for name in asked:
            workspace.manifest_path(name).unlink(missing_ok=True)
            workspace.forget_items(name)
    outputs: dict[str, str] = {}  # fingerprints of what each stage wrote
    reports = []
    for number, stage in enumerate(stages[:stop]):
        inputs = {name: outputs[name] for name in _before(stages, stage)}
        inputs |= _there(stages, stage, workspace) | external[stage.name] | stage.code()
        made = workspace.manifest(stage.name)
        due = _Due(stage, stage.settings(), inputs, made)
        files = workspace.files_path(stage.name)
        why = "" if number < start else asked.get(stage.name) or due.why(workspace)
        why = why or changed_file(files, workspace.root, verify=verify)
        if made is not None and number < start:
            # what follows is made of something else than the stage wrote, and has to know that
            outputs[stage.name] = f"{made.output}{', changed' if why else ''}"
            report = StageReport(stage.name, "skipped", made.seconds, made.counts, why)
        elif made is not None and not why:
            outputs[stage.name] = made.output
            report = StageReport(stage.name, "kept", made.seconds, made.counts, "")
        elif dry_run:
            stage.check()
            same = made is not None and made.fingerprint == due.mark
            outputs[stage.name] = made.output if made is not None and same else due.mark
            report = StageReport(stage.name, "pending", 0.0, {}, why)
        else:
            said = "starting" if why == _NOT_DONE else why
            say(f"{stage.name}, stage {number + 1} of {stop}: {said}")
            manifest, taken = _run(due, workspace, work, verify=verify)
            outputs[stage.name] = manifest.output
            report = StageReport(stage.name, "run", manifest.seconds, manifest.counts, why, taken)
        reports.append(report)
        say(describe(report))
    return reports


@dataclass(frozen=True)
class _Due:
    """A stage, what its output depends on now, and the manifest of what it made before."""

    stage: Stage
    settings: Mapping[str, Any]
    inputs: Mapping[str, str]
    made: Manifest | None

    @property
    def mark(self) -> str:
        """The fingerprint of what it would make."""
        return fingerprint(self.stage.name, self.stage.version, self.settings, self.inputs)

    def former_outputs(self) -> list[str]:
        """What it wrote and does not write now: options may give an output another name."""
        before = () if self.made is None else self.made.outputs
        return sorted(set(before) - set(self.stage.writes))

    def why(self, workspace: Workspace) -> str:
        """Why it has to run; empty when it need not."""
        made = self.made
        if made is None:
            return _NOT_DONE
        gone = [output for output in made.outputs if not workspace.path(output).exists()]
        if gone:
            return f"{gone[0]} is gone"
        if before := self.former_outputs():
            return f"{before[0]} is written no more"
        if made.fingerprint == self.mark:
            return ""
        if made.version != self.stage.version:
            return "a newer version of the stage"
        changed = _differences(made.inputs, self.inputs)
        # another plugin has another code; that it was chosen tells more
        read = [name for name in changed if not name.startswith(CODE_OF)]
        settings = json.loads(json.dumps(self.settings))  # knows no tuples
        options = _differences(made.options, settings)
        if options and not read:
            return f"options changed: {', '.join(options[:3])}"
        return f"{(read or changed)[0]} changed"


def _before(stages: Sequence[Stage], stage: Stage) -> list[str]:
    """Names of the stages that write what a stage reads."""
    earlier = stages[: stages.index(stage)]
    return [
        other.name
        for other in earlier
        if any(is_below(path, written) for path in stage.reads for written in other.writes)
    ]


def _there(stages: Sequence[Stage], stage: Stage, workspace: Workspace) -> dict[str, str]:
    """Fingerprints of what a stage reads that earlier runs left, and that none of these writes."""
    written = [path for other in stages for path in other.writes]
    missing = [path for path in stage.reads if not any(is_below(path, other) for other in written)]
    if not missing:
        return {}
    manifests = [m for path in workspace.manifest_paths() if (m := read_manifest(path)) is not None]
    found = {}
    for path in missing:
        made = [m for m in manifests if any(is_below(path, output) for output in m.outputs)]
        if not made:
            raise OptionError(
                f"stage {stage.name} reads {path}, which no stage has written in {workspace.root}"
            )
        found.update({manifest.stage: manifest.output for manifest in made})
    return found


def _external(stages: Sequence[Stage], workspace: Workspace) -> dict[str, dict[str, str]]:
    """Fingerprints of what stages read from outside the workspace; hashes are remembered in it."""
    remembered = workspace.path(HASHES)
    hashes = FileHashes(remembered)
    found = {stage.name: dict(stage.external(hashes)) for stage in stages}
    if hashes.content():
        write_bytes(remembered, (json.dumps(hashes.content()) + "\n").encode())
    return found


def _check_root(stage: Stage, workspace: Workspace) -> None:
    """Refuse to replace what was made of another root, unless that is gone, e.g. was renamed."""
    made = workspace.manifest(stage.name)
    held = "" if made is None else made.inputs.get(ROOT, "")
    if workspace.force or not held or not Path(held).is_dir():
        return
    if stage.root is None or str(stage.root.resolve()) != held:
        raise OptionError(
            f"{workspace.root} was made of {held}; give another folder for "
            f"{stage.root or 'other data'}, or --force to replace its content"
        )


def _with_followers(stages: Sequence[Stage], first: str) -> dict[str, str]:
    """A stage and those that read its output, directly or not, each with why it is run again."""
    found = {first: "asked for"}
    for stage in stages:
        if not found.keys().isdisjoint(_before(stages, stage)):
            found[stage.name] = f"follows {first}"
    return found


def _take_over(stage: Stage, workspace: Workspace) -> None:
    """Let no other stage count as done that wrote, under other options, what this one writes."""
    for path in workspace.manifest_paths():
        other = read_manifest(path)
        if other is None or other.stage == stage.name:
            continue
        if not set(other.outputs).isdisjoint(stage.writes):
            path.unlink(missing_ok=True)


def _differences(old: Any, new: Any, prefix: str = "") -> list[str]:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        found: list[str] = []
        for key in sorted(set(old) | set(new)):
            found += _differences(old.get(key), new.get(key), f"{prefix}.{key}" if prefix else key)
        return found
    return [] if old == new else [prefix]


def _run(due: _Due, workspace: Workspace, work: Work, *, verify: bool) -> tuple[Manifest, str]:
    """Run a stage; its manifest, and how many of its items were taken over."""
    stage = due.stage
    own = fingerprint(stage.name, stage.version, due.settings, stage.code())  # but what is read
    started = datetime.now(UTC).isoformat(timespec="seconds")
    clock = time.perf_counter()
    with workspace.staging(stage.name) as folder:
        journal, sources = folder / JOURNAL, workspace.item_sources(stage.name)
        kept = KeptItems(own, folder, journal, sources, _digest(workspace), verify=verify)
        settled = replace(work, kept=kept)
        counts = dict(stage.run(StageWork(**vars(settled), root=workspace.root, out=folder)))
        if work.executor is not None:
            clear_temporary(folder)  # workers of a cluster may die, and others do what they began
        # without its manifest a stage counts as not done: killed between here and the end, it
        # runs again whatever of its output has moved by then
        workspace.manifest_path(stage.name).unlink(missing_ok=True)
        _take_over(stage, workspace)
        written = tuple(o for o in stage.writes if (folder / o).exists())
        # before its files have moved: whichever of them have, the journal knows them
        if kept.num_items:
            hard_link(journal, workspace.items_path(stage.name))
        else:
            workspace.items_path(stage.name).unlink(missing_ok=True)
        workspace.publish(folder, tuple(stage.writes))
        workspace.remove(due.former_outputs())
    files = workspace.files_path(stage.name)
    content = remember_files(files, workspace.root, written, kept.states)
    manifest = Manifest(
        stage=stage.name,
        version=stage.version,
        options=dict(due.settings),
        inputs=dict(due.inputs),
        fingerprint=due.mark,
        content=content,
        outputs=written,
        counts=counts,
        seconds=round(time.perf_counter() - clock, 3),
        started=started,
        versions=package_versions(),
    )
    write_json_model(workspace.manifest_path(stage.name), manifest)
    return manifest, f"{kept.num_kept} of {kept.num_items} kept" if kept.num_kept else ""


def _digest(workspace: Workspace) -> Digest:
    """Hashes of files: of what stages wrote and what was imported they are remembered."""
    root = os.path.realpath(workspace.root)

    @cache
    def hashes() -> FileHashes:
        records = [written_files(path) for path in (workspace.root / "stages").glob("*.files")]
        written = {f"{root}/{path}": state for files in records for path, state in files.items()}
        return FileHashes(workspace.path(HASHES), written)

    return lambda path: hashes().of_file(Path(os.path.realpath(path)))


def all_kept(reports: Iterable[StageReport]) -> bool:
    """Whether nothing had to be done."""
    return all(report.state in ("kept", "skipped") for report in reports)


def describe(report: StageReport) -> str:
    """One line about a stage."""
    if report.state == "kept":
        return f"{report.name}: up to date"
    if report.state == "skipped":
        return f"{report.name}: taken as it is{f'; {report.why}' if report.why else ''}"
    if report.state == "pending":
        return f"{report.name}: would run ({report.why})"
    counts = ", ".join(count_text(*count) for count in report.counts.items())
    parts = filter(None, (counts, report.kept_items, f"{report.seconds:.1f} s"))
    return f"{report.name}: {'; '.join(parts)}"
