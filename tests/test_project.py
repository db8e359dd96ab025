"""The project's own files agree with each other, and the environment is one that works."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from megloc_kapture.errors import _EXTRAS, missing_extra

REPOSITORY = Path(__file__).resolve().parent.parent
PROJECT, TWINS = (
    tomllib.loads((REPOSITORY / folder / "pyproject.toml").read_text())["project"]
    for folder in ("", "twins")
)
REQUIREMENTS = [
    Requirement(text)
    for texts in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    for text in texts
]


def test_dependencies_are_pinned_inside_their_ranges() -> None:
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    versions = {canonicalize_name(name): version for name, version in pairs}
    for one in REQUIREMENTS:
        assert one.specifier.contains(versions[canonicalize_name(one.name)]), one.name


def test_messages_name_extras_that_exist() -> None:
    for package in _EXTRAS:
        hint = missing_extra(ModuleNotFoundError(name=package)) or ""
        assert re.findall(r"\[(.*)\]", hint)[0] in PROJECT["optional-dependencies"], package


def test_nothing_is_there_that_breaks_others() -> None:
    # a torchvision that does not fit torch breaks transformers; timm brings torchvision
    assert importlib.util.find_spec("torchvision") is importlib.util.find_spec("timm") is None
    # both distributions write into the same cv2 folder; the last one installed wins
    names = {canonicalize_name(d.name) for d in importlib.metadata.distributions()}
    assert {name for name in names if name.startswith("opencv")} == {"opencv-python-headless"}
    # a package of that name breaks every console script of kapture 1.1.12
    assert not (REPOSITORY / "tools").exists()


def test_the_twins_need_what_the_package_has() -> None:
    package, *others = (Requirement(text) for text in TWINS["dependencies"])
    assert package.name == PROJECT["name"] and package.specifier.contains(PROJECT["version"])
    assert TWINS["version"] == PROJECT["version"]
    assert {str(other) for other in others} <= set(PROJECT["dependencies"])
    for key in ("requires-python", "license", "authors"):
        assert TWINS[key] == PROJECT[key]


@pytest.mark.skipif(not (REPOSITORY / ".git").exists(), reason="an unpacked distribution")
def test_the_source_distribution_has_all_that_a_clone_has() -> None:
    targets = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True)
    names = {name.partition("/")[0] for name in listed.stdout.splitlines()}
    visible = {f"/{name}" for name in names if not name.startswith(".")}
    # which is always in it
    assert {*targets["targets"]["sdist"]["include"], "/pyproject.toml"} == visible


@pytest.mark.parametrize(
    ("arguments", "networks"),
    [(["eval", "PRESET=classic"], False), (["eval", "PRESET=modern"], True), (["test"], True)],
)
def test_make_eval_sets_up_no_more_than_its_preset_needs(
    arguments: list[str], networks: bool, tmp_path: Path
) -> None:
    def commands() -> str:
        make = ["make", "-n", f"VENV={tmp_path}", *arguments]
        return subprocess.run(make, cwd=REPOSITORY, capture_output=True, text=True).stdout

    assert "pip install" in commands() and ("[cluster,dev,docs,serve]" in commands()) == networks
    stamps = re.findall(rf"touch {tmp_path}/(\S+)", commands())
    assert len(stamps) == 1 + networks
    # what has both needs nothing
    (tmp_path / stamps[-1].replace(".base", ".installed")).touch()
    (tmp_path / stamps[0]).touch()
    assert "pip install" not in commands()


def test_registered_plugins_and_command_exist() -> None:
    registered = [
        entry
        for name in ("megloc-kapture", "megloc-twins")
        for entry in importlib.metadata.distribution(name).entry_points
    ]
    assert {"megloc", "synthetic"} <= {entry.name for entry in registered}
    for entry in registered:
        assert callable(entry.load()), entry


def test_unusable_python_is_refused_in_one_line() -> None:
    done = subprocess.run(
        ["sh", "scripts/find_python.sh"],
        cwd=REPOSITORY,
        env={"PATH": "/usr/bin:/bin", "PYTHON": "/bin/false"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"Python 3\.11 or newer is needed.*\n", done.stderr)
