"""Images are linked, never copied or changed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from megloc_kapture.io.atomic import output_error


def link_images(source_root: Path, output_root: Path) -> None:
    """Make ``output_root/sensors/records_data`` (and masks) a link to ``source_root``'s.

    Raises
    ------
    OutputError : the link cannot be made.
    """
    for name in ("records_data", "masks"):
        source = Path(source_root).resolve() / "sensors" / name
        place = Path(output_root) / "sensors" / name
        if not source.exists():
            continue
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            if place.is_symlink():
                place.unlink()
            place.symlink_to(source.resolve(), target_is_directory=True)
        except OSError as error:
            raise output_error(place, error) from error


def link_records(output_root: Path, links: Mapping[str, Path]) -> None:
    """Make folders or images below ``output_root/sensors/records_data`` links to a dataset's.

    Parameters
    ----------
    links : path below ``records_data`` -> the folder or file it shows; ``""`` is ``records_data``
        itself.

    Raises
    ------
    OutputError : a link cannot be made.
    """
    records = Path(output_root) / "sensors" / "records_data"
    for name, target in links.items():
        place = records / name if name else records
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            place.symlink_to(Path(target).resolve(), target_is_directory=True)
        except OSError as error:
            raise output_error(place, error) from error


def link_file(source: Path, place: Path) -> None:
    """Make ``place`` a link to one file.

    Raises
    ------
    OutputError : the link cannot be made.
    """
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        place.symlink_to(Path(source).resolve())
    except OSError as error:
        raise output_error(place, error) from error


def hard_link(source: Path, place: Path) -> None:
    """Make ``place`` another name of a file, or a copy of it where the file system has no such.

    Raises
    ------
    OutputError : cannot be written.
    """
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        try:
            os.link(source, place)
        except OSError:  # another file system, or one without hard links
            shutil.copyfile(source, place)
    except OSError as error:
        raise output_error(place, error) from error
