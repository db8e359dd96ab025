"""The registry of networks' published checkpoints: file, page, licence, sha256.

The facts stand in ``registry.toml`` beside this file, validated when first asked for.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints

from megloc_kapture.errors import OptionError, suggestion
from megloc_kapture.io.files import check_component, check_relative

_TABLE = Path(__file__).with_suffix(".toml")
_Url = Annotated[str, StringConstraints(pattern=r"^https?://[\w.:-]+/\S*$")]
_Text = Annotated[str, StringConstraints(min_length=1)]
_FileName = Annotated[str, AfterValidator(check_relative)]


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PublishedFile(_Entry):
    """One file that a network's weights are published in.

    Attributes
    ----------
    name : where it lies in the folder of weights.
    also : other names under which other tools keep the same file.
    url : where it can be fetched; None: only a person can, from the network's page.
    size : bytes; None: not known.
    sha256 : hexadecimal; None: not known.
    """

    name: _FileName
    also: tuple[_FileName, ...] = ()
    url: _Url | None = None
    size: Annotated[int, Field(gt=0)] | None = None
    sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """All names that the file may have."""
        return (self.name, *self.also)


class Weights(_Entry):
    """The checkpoint of one network.

    Attributes
    ----------
    purpose : what the network does.
    page : where a person finds it.
    licence, terms : its short name, and what one may do in plain words.
    commercial : whether commercial use is plainly allowed.
    files : alternatives, preferred first; any one is enough.
    unverified : what nobody has confirmed on the original file; empty: nothing.
    """

    name: Annotated[str, AfterValidator(check_component)]
    purpose: _Text
    page: _Url
    licence: _Text
    terms: _Text
    commercial: bool
    files: Annotated[tuple[PublishedFile, ...], Field(min_length=1)]
    unverified: str = ""

    @property
    def converted(self) -> str:
        """Name of the file that ``megloc weights convert`` makes of any of them."""
        return f"{self.name}.safetensors"

    @property
    def to_fetch(self) -> PublishedFile | None:
        """The file that a program can fetch."""
        return next((file for file in self.files if file.url), None)


@lru_cache(maxsize=1)
def registry() -> Mapping[str, Weights]:
    """All networks by name, in the order they are listed in."""
    table = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
    return MappingProxyType({name: Weights(name=name, **entry) for name, entry in table.items()})


def lookup(name: str) -> Weights:
    """The entry of a network; raises OptionError, which lists the names there are."""
    if name not in registry():
        told = suggestion(name, registry(), listed="there are ")
        raise OptionError(f"no weights {name!r} in the registry; {told}")
    return registry()[name]


def by_sha256(sha256: str) -> tuple[Weights, PublishedFile] | None:
    """The network and file of a checksum."""
    return next((found for found in _all_files() if found[1].sha256 == sha256), None)


def by_file_name(name: str) -> tuple[Weights, PublishedFile] | None:
    """The network and file of a name without folders."""
    for weights, file in _all_files():
        if name in [path.rpartition("/")[2] for path in file.names]:
            return weights, file
    return None


def _all_files() -> list[tuple[Weights, PublishedFile]]:
    return [(weights, file) for weights in registry().values() for file in weights.files]
