"""Which of 4Seasons' recordings are the map and which the queries, and the files between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.fourseasons_recordings import (
    Recording,
    RelocalizationFile,
    find_recordings,
    find_relocalization_files,
)
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError, OptionError

# stands in the list of what is missing where there is a recording for the map only
ANOTHER_RECORDING = "<another recording, for the queries>"


@dataclass(frozen=True)
class Selection:
    """What is imported.

    Parameters
    ----------
    recordings : all that are there, by name.
    references, queries : those of the map and those of the queries, sorted by name.
    files : the relocalization files between them.
    """

    recordings: dict[str, Recording]
    references: list[Recording]
    queries: list[Recording]
    files: list[RelocalizationFile]


def select(
    root: Path, reference: Sequence[str], queries: Sequence[str], missing: Missing
) -> Selection:
    """Choose recordings by name; where no names are given, by what the dataset says.

    Parameters
    ----------
    reference : recordings of the map. Without: the sources of the relocalization files; without
        such files the first recording with poses.
    queries : recordings of the queries. Without: the targets of the relocalization files of these
        sources; without such files all others.
    missing : takes recordings that relocalization files mean and that are not there.

    Raises
    ------
    DataError : there is nothing to choose from.
    OptionError : a name is unknown, or given for both.
    """
    recordings = find_recordings(root)
    files = find_relocalization_files(root, recordings)
    _check_names("reference", reference, recordings, root)
    _check_names("queries", queries, recordings, root)
    both = sorted(set(reference) & set(queries))
    if both:
        raise OptionError(f"recording {both[0]!r} is given for the map and for the queries")
    sources = sorted(set(reference)) or _default_references(recordings, files, set(queries))
    targets = sorted(set(queries))
    if not targets:
        targets = sorted({f.target for f in files if f.source in sources} - set(sources))
    if not targets:
        targets = [name for name in recordings if name not in sources]
    missing.files += [root / name for name in (*sources, *targets) if name not in recordings]
    sources, targets = ([n for n in names if n in recordings] for names in (sources, targets))
    if not sources:
        raise DataError(
            f"{len(recordings)} recordings, none for the map; needed are one with published poses "
            "(GNSSPoses.txt or poses.txt) and another for the queries",
            path=root,
        )
    if not targets:
        missing.files.append(root / ANOTHER_RECORDING)
    return Selection(
        recordings,
        [recordings[name] for name in sources],
        [recordings[name] for name in targets],
        [file for file in files if file.source in sources and file.target in targets],
    )


def _check_names(
    option: str, names: Iterable[str], recordings: Mapping[str, Recording], root: Path
) -> None:
    unknown = sorted(set(names) - set(recordings))
    if unknown:
        known = ", ".join(recordings)
        raise OptionError(
            f"option {option}: no recording {unknown[0]!r} in {root}; there are {known}"
        )


def _default_references(
    recordings: Mapping[str, Recording], files: Sequence[RelocalizationFile], queries: set[str]
) -> list[str]:
    sources = sorted({file.source for file in files} - queries)
    with_poses = (name for name, recording in recordings.items() if recording.has_poses)
    return sources or [name for name in with_poses if name not in queries][:1]
