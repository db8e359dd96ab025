"""``benchmarks/<dataset>.toml``: a dataset's options, protocol and published figures."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.io.side_tables import Protocol
from megloc_kapture.pipeline.presets import DEFAULT_PRESET
from megloc_kapture.values import Options

_PACKAGE = Path(__file__).resolve().parent.parent
# in a wheel the files lie inside the package, in a checkout beside it
_PLACES = (_PACKAGE / "benchmarks", _PACKAGE.parent / "benchmarks")


class PublishedResult(Options):
    """Figures of another method on the dataset, to be read beside ours.

    Parameters
    ----------
    method, source : what was measured, and where it is published.
    recall : condition -> percent at the dataset's thresholds, as papers print it.
    """

    method: str
    source: str
    recall: dict[str, str]


class BenchmarkFile(Options):
    """``benchmarks/<dataset>.toml``: how one dataset is run.

    Parameters
    ----------
    import_options : the adapter's.
    options : changes to the preset.
    options_with_query_depth : further ones, where the queries come with depth maps of their own.
    thresholds, conditions, pools : instead of the dataset's own (see the side tables' Protocol).
    published : what others have reached.
    """

    dataset: str
    preset: str = DEFAULT_PRESET
    thresholds: tuple[tuple[float, float | None], ...] | None = None
    conditions: tuple[str, ...] | None = None
    pools: dict[str, tuple[str, ...]] | None = None
    import_options: dict[str, Any] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)
    options_with_query_depth: dict[str, Any] = Field(default_factory=dict)
    published: tuple[PublishedResult, ...] = ()

    def changes(self, *, query_depth: bool) -> list[dict[str, Any]]:
        """Changes to the preset, in order, for data whose queries have depth or not."""
        return [self.options, *([self.options_with_query_depth] if query_depth else [])]

    def change(self, protocol: Protocol) -> Protocol:
        """A dataset's protocol with what this file wants different."""
        wanted = {
            "thresholds": self.thresholds,
            "conditions": self.conditions,
            "pools": self.pools,
        }
        return protocol.model_copy(update={k: v for k, v in wanted.items() if v is not None})


def find_benchmark(dataset: str, twin_prefix: str) -> BenchmarkFile:
    """The benchmark file of a dataset that comes with the package; defaults where there is none.

    A rendered twin runs as its dataset does, but nobody has published figures on it.

    Raises
    ------
    DataError : the file is broken.
    """
    for name in (dataset, dataset.removeprefix(twin_prefix)):
        for place in _PLACES:
            path = place / f"{name}.toml"
            if path.is_file():
                found = read_benchmark(path)
                if name == dataset:
                    return found
                return found.model_copy(update={"dataset": dataset, "published": ()})
    return BenchmarkFile(dataset=dataset)


def read_benchmark(path: Path) -> BenchmarkFile:
    """Read a benchmark file.

    Raises
    ------
    DataError : absent, not TOML, or a key or value that is not of it; names the file.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        return BenchmarkFile.model_validate(content)
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror}", path=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"not TOML: {error}", path=path) from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DataError(f"{where}: {first['msg']}", path=path) from error
