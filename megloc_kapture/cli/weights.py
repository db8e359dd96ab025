"""``megloc weights`` and ``doctor``: weights of networks and their licences; environment checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Output, Overwrite
from megloc_kapture.errors import (
    DataError,
    MeglocError,
    OptionError,
    OutputError,
    check_option,
    missing_extra,
)
from megloc_kapture.evaluation.pose_files import PACKAGES, installed_version
from megloc_kapture.evaluation.report.content import as_text
from megloc_kapture.io.weights import (
    MissingWeightsError,
    PublishedFile,
    Weights,
    WeightsFile,
    add_weights,
    convert_weights,
    describe,
    fetch,
    files_of,
    how_to_convert,
    how_to_get,
    lookup,
    read_weights,
    registry,
    sha256_of,
    to_convert,
    weights_folder,
)
from megloc_kapture.pipeline.presets import check_weights, options_of_preset

WRONG_FILES = 2


@dataclass(frozen=True, kw_only=True)
class List(Common):
    """List all networks with the file, size, licence and state of their weights."""

    def run(self) -> None:
        import pandas as pd  # slow import

        print(as_text(pd.DataFrame([_row(weights) for weights in registry().values()])))
        print(f"\nfolder of weights: {weights_folder()}")
        print("(!) megloc weights fetch needs --accept-licence")
        print("* not checked against the original file:")
        for weights in registry().values():
            if weights.unverified:
                print(f"  {weights.name}: {weights.unverified}")


@dataclass(frozen=True, kw_only=True)
class Fetch(Common):
    """Download published weights, check them, and save them."""

    names: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[NAME...]")] = ()
    """Names of networks, as listed."""
    preset: str | None = None
    """Fetch all missing weights of this preset."""
    accept_licence: bool = False
    """Agree to a licence that does not plainly allow commercial use."""
    force: Overwrite = False
    """Replace an existing file."""

    def run(self) -> None:
        names = self.names
        if self.preset is not None:
            names = tuple(dict.fromkeys((*names, *_missing(self.preset))))
            if not names:
                print(f"{self.preset}: no weights are missing")
        elif not names:
            raise OptionError(f"choose weights to fetch: {', '.join(registry())}")
        wanted, refused = [], []
        for name in names:
            weights = lookup(name)
            if weights.to_fetch is None and (present := next(files_of(weights), None)):
                print(f"{name}: already present, {present.path}")
                continue
            try:
                wanted.append(_fetchable(weights, self.accept_licence))
            except (MissingWeightsError, OptionError) as error:
                if self.preset is None:
                    raise
                refused.append(str(error))
        for weights, file, url in wanted:
            self._fetch(weights, file, url)
        if refused:
            raise MissingWeightsError("\n".join(refused))

    def _fetch(self, weights: Weights, file: PublishedFile, url: str) -> None:
        place = weights_folder() / file.name
        if place.is_file() and not self.force:
            if file.sha256 in (None, sha256_of(describe(weights.name, place))):
                print(f"{weights.name}: already present, {place}")
                _say_to_convert(weights, file, place)
                return
            raise OutputError(f"{place}: exists, but is not the published file; -f replaces it")

        self.say(f"{weights.name}: {url}")
        self.say(f"  licence: {weights.licence}: {weights.terms}")
        fetch(url, place, sha256=file.sha256, track=self.track)
        downloaded = describe(weights.name, place, file)
        if file.sha256 is None and not file.convert:
            try:
                read_weights(downloaded)
            except DataError:
                place.unlink()
                raise
        print(f"{weights.name}: {place} ({downloaded.size} bytes, {_trust(downloaded)})")
        _say_to_convert(weights, file, place)


@dataclass(frozen=True, kw_only=True)
class Add(Common):
    """Check a downloaded file and copy it into the folder of weights."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Downloaded file, or X.safetensors that scripts/convert_weights.py has written."""
    name: str | None = None
    """Network of the file; if omitted, recognised by sha256 or file name."""
    unverified: bool = False
    """Accept a file that is not the published one, such as one that you trained."""
    force: Overwrite = False
    """Replace an existing, different file."""

    def run(self) -> None:
        added = add_weights(self.file, name=self.name, force=self.force, unverified=self.unverified)
        print(f"{added.name}: {added.path} ({_trust(added)})")


@dataclass(frozen=True, kw_only=True)
class Convert(Common):
    """Convert a torch checkpoint to safetensors."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """torch checkpoint; scripts/convert_weights.py converts other files."""
    output: Output
    """File to write; must end in .safetensors."""
    force: Overwrite = False
    """Overwrite an existing file."""

    def run(self) -> None:
        count = convert_weights(self.file, self.output, force=self.force)
        print(f"{self.output}: {count} tensors")


@dataclass(frozen=True, kw_only=True)
class Check(Common):
    """Check the existing files: sha256 if known, and safe loading."""

    names: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[NAME...]")] = ()
    """Names of networks, as listed; if omitted, all that are present."""

    def run(self) -> int:
        """Return 2 if a file is wrong."""
        present = [name for name, of in registry().items() if _state(of) == "present"]
        names = self.names or present
        check_option(names, f"{weights_folder()}: no weights to check")
        wrong = sum(_wrong(lookup(name)) for name in names)
        print(f"wrong files: {wrong}" if wrong else "all files are correct")
        return WRONG_FILES if wrong else 0


@dataclass(frozen=True, kw_only=True)
class WeightsCommand:
    """List, fetch, add, convert and check the weights of networks."""

    action: (
        Annotated[List, tyro.conf.subcommand("list", description=List.__doc__)]
        | Annotated[Fetch, tyro.conf.subcommand("fetch", description=Fetch.__doc__)]
        | Annotated[Add, tyro.conf.subcommand("add", description=Add.__doc__)]
        | Annotated[Convert, tyro.conf.subcommand("convert", description=Convert.__doc__)]
        | Annotated[Check, tyro.conf.subcommand("check", description=Check.__doc__)]
    )


def summary() -> str:
    present = [weights.name for weights in registry().values() if _state(weights) == "present"]
    names = f": {', '.join(present)}" if present else ""
    return f"{len(present)} of {len(registry())} in {weights_folder()}{names}"


def _missing(preset: str) -> tuple[str, ...]:
    try:
        check_weights(options_of_preset(preset))
    except MissingWeightsError as error:
        return error.names
    return ()


def _say_to_convert(weights: Weights, file: PublishedFile, place: Path) -> None:
    if file.convert and next(files_of(weights), None) is None:
        print(f"{weights.name}: convert it once: {how_to_convert(weights, place)}")


def _fetchable(weights: Weights, accepted: bool) -> tuple[Weights, PublishedFile, str]:
    file = weights.to_fetch
    if file is None or file.url is None:
        raise MissingWeightsError(f"no automatic download: {how_to_get(weights)}")
    check_option(
        weights.commercial or accepted,
        f"{weights.name} needs your consent to its licence: {weights.licence}: {weights.terms} "
        f"(full text at {weights.page}); to agree, add --accept-licence",
    )
    return weights, file, file.url


def _wrong(weights: Weights) -> int:
    """Print the state of each file of a network; return the number of problems."""
    files = list(files_of(weights))
    problems = [] if files else [how_to_get(weights)]
    for file in files:
        try:
            read_weights(file)
            print(f"{weights.name}: {file.path} ({_trust(file)})")
        except MeglocError as error:
            problems.append(str(error))
    for problem in problems:
        print(f"wrong: {problem}")
    return len(problems)


def _trust(file: WeightsFile) -> str:
    if file.published and file.published.sha256:
        return "sha256 correct"
    return f"sha256 {sha256_of(file)}; the registry lists no sha256"


def _state(weights: Weights) -> str:
    if next(files_of(weights), None):
        return "present"
    return "to convert" if to_convert(weights) else "missing"


def _row(weights: Weights) -> dict[str, str]:
    present = [file.published for file in files_of(weights)]
    file = next(
        (candidate for candidate in weights.files if candidate in present), weights.files[0]
    )
    return {
        "name": f"{weights.name} *" if weights.unverified else weights.name,
        "purpose": weights.purpose,
        "file": " | ".join(f.name for f in weights.files),
        "size": "?" if file.size is None else f"{file.size / 1e6:.2f} MB",
        "licence": weights.licence if weights.commercial else f"{weights.licence} (!)",
        "state": _state(weights),
        "sha256": "known" if file.sha256 else "not known",
    }


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Check the environment: versions, incompatible packages, GPU, weights."""

    def run(self) -> None:
        """Print the environment and exit with 2 if something is wrong."""
        for package in (*PACKAGES, "kapture", "numba"):
            print(f"{package:24s}{installed_version(package) or 'not installed'}")
        print(f"{'GPU':24s}{gpu()}")
        print(f"{'weights':24s}{summary()}")
        problems = find_problems()
        for problem in problems:
            print(f"problem: {problem}")
        if problems:
            raise MeglocError(f"problems found: {len(problems)}, see above")
        print("no problem found")


def gpu() -> str:
    try:
        import torch
    except ModuleNotFoundError as error:
        return f"unknown: {missing_extra(error) or error}"

    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"


def find_problems() -> list[str]:
    """Return installed combinations of packages that are known to fail, with remedies."""
    problems = []
    torch, vision = installed_version("torch"), installed_version("torchvision")
    if vision and torch and "+cpu" in torch and "+cpu" not in vision:
        problems.append(
            f"torchvision {vision} may fail to import with torch {torch}, and then breaks "
            "transformers; pip uninstall torchvision"
        )
    if installed_version("opencv-python") and installed_version("opencv-python-headless"):
        problems.append(
            "opencv-python and opencv-python-headless both write the folder cv2; uninstall "
            "both and install opencv-python-headless"
        )
    return problems
