"""What the commands of single stages share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from megloc_kapture.cli.common import Choosing, Common, Working, side_tables_beside
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import staged_output
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, assigned, options_of_preset
from megloc_kapture.plugins import chosen_by_name
from megloc_kapture.stages.candidates import UNRESTRICTED, Restrictions
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.work import Work

FEATURES = "features"


@dataclass(frozen=True, kw_only=True)
class StageCommand(Choosing, Working, Common):
    uses: ClassVar[tuple[str, ...]] = ()
    """The options that the command acts on, by their first key; --set takes no others."""

    def options(
        self, changes: dict[str, object] | None = None, *, also: Sequence[str] = ()
    ) -> PipelineOptions:
        """The preset's options, with what the flags change.

        Parameters
        ----------
        also : options that are acted on beside :attr:`uses`, because of other flags.

        Raises
        ------
        OptionError : see ``options_of_preset``; or a device is given and no network is used.
        """
        used = (*self.uses, *also)
        options = options_of_preset(
            self.preset or DEFAULT_PRESET,
            changes=[changes or {}, assigned(self.placement())],
            assignments=self.set,
            used=used,
        )
        self.check_computes(tuple(getattr(options, name) for name in used))
        return options

    def named(self, key: str, names: Sequence[str]) -> dict[str, object]:
        """Changes that choose plugins by their names, with the settings that the preset has of
        them; none without names."""
        preset = getattr(options_of_preset(self.preset or DEFAULT_PRESET), key)
        return {key: chosen_by_name(preset, names)} if names else {}

    @contextmanager
    def working(self, output: Path) -> Iterator[Work]:
        """What to work with, by the flags; all workers must see the folder of the output."""
        folder = output if output.is_dir() else output.absolute().parent
        with single_threaded(), self.open_executor(folder) as executor:
            yield Work(executor, self.console().track)

    @contextmanager
    def staged(self, output: Path, kind: str, *, force: bool) -> Iterator[tuple[Path, Work]]:
        """Where to write an output of a kind until it is whole, and what to work with."""
        with staged_output(output, kind=kind, force=force) as out, self.working(out) as work:
            yield out, work

    def features_folder(
        self, output: Path, *, force: bool
    ) -> AbstractContextManager[tuple[Path, Work]]:
        """Where to write features or matches, and what to work with."""
        return self.staged(output, FEATURES, force=force)


def only_type(folder: KaptureFolder, kind: str, asked: str | None) -> str:
    """The type of a kind that is meant: the one asked for, or the only one; raises OptionError."""
    types = folder.types(kind)  # type: ignore[arg-type]
    if asked is not None:
        if asked not in types:
            there = ", ".join(types) or "none"
            raise OptionError(f"{folder.root}: no {kind} of type {asked!r}; there are: {there}")
        return asked
    if len(types) != 1:
        raise OptionError(
            f"{folder.root}: "
            + (f"several types of {kind}, name one: {', '.join(types)}" if types else f"no {kind}")
            + ("" if types else "; give their folder with --features-dir")
        )
    return types[0]


def restrictions_beside(folder: Path) -> Restrictions:
    """Of the dataset whose tables lie beside a kapture folder; none where there are none."""
    tables = side_tables_beside(folder)
    return UNRESTRICTED if tables is None else Restrictions.read(tables)
