"""Plugins are found by entry point in any installed package, and refused by name with a reason."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import megloc_kapture as megloc
from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.plugin_loading import checked_array, load_plugin, plugin_names
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS
from megloc_kapture.stages.local_features import _extract
from megloc_kapture.values import LocalFeatures

MODULE = """
    import numpy as np
    from megloc_kapture.values import LocalFeatures, Options

    class GridOptions(Options):
        step: int = 50

    class Grid:
        name = "grid"
        Options = GridOptions

        def __init__(self, options=None):
            self.options = options or GridOptions()

        def extract(self, image, mask=None):
            height, width = image.shape[:2]
            y, x = np.mgrid[: height : self.options.step, : width : self.options.step]
            xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32) + np.float32(0.5)
            ones = np.ones((len(xy), 4), np.float32)
            return LocalFeatures(xy, ones[:, 0], ones)

    class Nameless:
        def extract(self, image, mask=None):
            raise NotImplementedError

    class Plain(Nameless):
        name = "plain"

    class Loose(Plain):
        class Options:
            step = 50

    class Deaf:
        name = "deaf"

    def function(image):
        return None

    class Moody(Plain):
        def __init__(self):
            raise ValueError("not today")
"""
NAMES = ("Grid", "Plain", "Nameless", "Deaf", "Loose", "function", "Moody", "Absent")
ENTRY_POINTS = f"""
    [megloc_kapture.local_features]
    {"".join(f"{name.lower()} = outside_plugin:{name}{chr(10)}    " for name in NAMES)}
    broken = outside_plugin_broken:Grid
"""


def install(folder: Path, distribution: str, modules: dict[str, str], entry_points: str) -> None:
    """Write modules and a folder of metadata, as pip does."""
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(textwrap.dedent(text))
    metadata = folder / f"{distribution}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n"
    )
    (metadata / "entry_points.txt").write_text(textwrap.dedent(entry_points))


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    install(
        tmp_path,
        "outside_plugin",
        {"outside_plugin": MODULE, "outside_plugin_broken": "raise RuntimeError('no licence')"},
        ENTRY_POINTS,
    )
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("outside_plugin", "outside_plugin_broken"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    return tmp_path


def test_a_plugin_of_another_package_is_found_and_works(outside: Path) -> None:
    assert {"grid", "plain", "rootsift"} <= set(plugin_names(LOCAL_FEATURES))
    assert plugin_names(LOCAL_FEATURES) == sorted(plugin_names(LOCAL_FEATURES))
    grid = load_plugin(LOCAL_FEATURES, "grid", {"step": 20})
    features = grid.extract(np.zeros((40, 60, 3), np.uint8))
    assert isinstance(features, LocalFeatures)
    assert len(features.keypoints_px) == 6
    # it needs no options
    assert load_plugin(LOCAL_FEATURES, "plain").name == "plain"
    assert load_plugin(LOCAL_FEATURES, "plain", {}).name == "plain"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nameless", r"'nameless' \(outside_plugin:Nameless\) does not implement L.* lacks name"),
        ("deaf", r"'deaf' \(outside_plugin:Deaf\) does not implement LocalF.* lacks extract"),
        ("loose", "'loose': its Options are not derived from megloc_kapture.values.Options"),
        ("function", r"'function' .* does not implement LocalFeatureExtractor: it is not a class"),
        ("absent", r"'absent' \(outside_plugin:Absent\) cannot be loaded: .*Absent"),
        ("broken", r"'broken' \(outside_plugin_broken:Grid\) cannot be loaded: no licence"),
        ("moody", r"'moody' cannot be created: not today"),
        ("missing", r"no plugin 'missing' in megloc_kapture.local_features; reg.*: .*rootsift"),
    ],
)
def test_a_wrong_plugin_is_refused_by_name_with_the_reason(
    outside: Path, name: str, message: str
) -> None:
    with pytest.raises(PluginError, match=message) as caught:
        load_plugin(LOCAL_FEATURES, name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("grid", {"step": "wide"}, r"'grid' rejects its options: .*step.* valid integer"),
        ("grid", {"steps": 3}, "'grid' rejects .* unknown option 'steps'; did you mean 'step'"),
        ("plain", {"step": 3}, r"'plain' rejects its options: it takes no options, got step"),
    ],
)
def test_wrong_options_are_refused(
    outside: Path, name: str, options: dict[str, object], message: str
) -> None:
    with pytest.raises(PluginError, match=message):
        load_plugin(LOCAL_FEATURES, name, options)


@pytest.mark.parametrize(
    ("group", "name", "value", "message"),
    [
        # of two packages
        (LOCAL_FEATURES, "grid", "rival:Grid", "registered twice.*outside_plugin:Grid.*rival:Grid"),
        (MATCHERS, "crossed", "rival:Grid", "does not implement Matcher: it lacks match"),
    ],
    ids=["the same name", "no matcher"],
)
def test_a_second_package_may_not_mix_up_names_and_groups(
    outside: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    group: str,
    name: str,
    value: str,
    message: str,
) -> None:
    rival = tmp_path_factory.mktemp("rival")
    install(rival, "rival", {"rival": MODULE}, f"[{group}]\n{name} = {value}\n")
    monkeypatch.syspath_prepend(rival)
    with pytest.raises(PluginError, match=message):
        load_plugin(group, name)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        ([[1.0]], r"x: got list, expected float32 or uint8 \(N, 2\)"),
        (np.ones((1, 2)), r"got float64 \(1, 2\), expected"),
        (np.ones(2, np.float32), r"got float32 \(2,\), expected"),
        (np.ones((1, 3), np.float32), r"got float32 \(1, 3\), expected"),
        (np.full((1, 2), np.nan, np.float32), "some values are not finite"),
    ],
)
def test_arrays_of_plugins_are_checked(array: Any, message: str) -> None:
    with pytest.raises(PluginError, match=message):
        checked_array("plugin x", array, (None, 2), "float32", "uint8")
    with pytest.raises(PluginError, match=r"expected uint8 \(N, D\)"):
        checked_array("plugin x", np.ones(2), (None, None), "uint8")
    whole = np.ones((3, 2), np.uint8)
    assert checked_array("plugin x", whole, (None, 2), "float32", "uint8") is whole


def test_outputs_are_checked_from_python(outside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.zeros((100, 100, 3), np.uint8)
    assert len(megloc.extract("grid", image).keypoints_px) == 4
    kind = type(load_plugin(LOCAL_FEATURES, "grid"))
    monkeypatch.setattr(kind, "extract", lambda *_: np.zeros((5, 2)))
    with pytest.raises(PluginError, match="'grid' on image given: got ndarray, expected LocalF"):
        megloc.extract("grid", image)

    given: Any = kind()
    with pytest.raises(PluginError, match="must be given by its registered name, got <outside"):
        megloc.extract(given, image)

    def reject(*_: object) -> None:
        raise DataError("too small")

    monkeypatch.setattr(kind, "extract", reject)
    with pytest.raises(DataError, match=r"^a\.png: too small"):
        _extract(load_plugin(LOCAL_FEATURES, "grid"), [("a.png", Any)], [(image, None)])  # type: ignore[list-item]
