"""``benchmarks/<dataset>.toml``: a dataset's options, protocol and published figures."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError, field_validator

from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import Protocol
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, PRESETS
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


class PresetOptions(Options):
    """What a dataset wants different of one preset alone, after what it wants of all of them.

    Parameters
    ----------
    import_options : the adapter's.
    options : changes to the preset.
    """

    import_options: dict[str, Any] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)


class BenchmarkFile(Options):
    """``benchmarks/<dataset>.toml``: how one dataset is run.

    Parameters
    ----------
    import_options : the adapter's.
    options : changes to every preset.
    presets : further ones to the preset of a name.
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
    presets: dict[str, PresetOptions] = Field(default_factory=dict)
    options_with_query_depth: dict[str, Any] = Field(default_factory=dict)
    published: tuple[PublishedResult, ...] = ()

    @field_validator("presets")
    @classmethod
    def _known_presets(cls, presets: dict[str, PresetOptions]) -> dict[str, PresetOptions]:
        unknown = sorted(set(presets) - set(PRESETS))
        if unknown:
            raise ValueError(f"unknown preset {unknown[0]!r}; known: {', '.join(PRESETS)}")
        return presets

    def changes(self, preset: str, *, query_depth: bool) -> list[dict[str, Any]]:
        """Changes to a preset, in order, for data whose queries have depth or not."""
        own = self.presets.get(preset, PresetOptions()).options
        return [self.options, own, *([self.options_with_query_depth] if query_depth else [])]

    def import_options_of(self, preset: str) -> dict[str, Any]:
        """The adapter's options, where this preset is run."""
        return self.import_options | self.presets.get(preset, PresetOptions()).import_options

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
