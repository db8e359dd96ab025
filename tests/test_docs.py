"""The examples and links of README.md and docs/, as their readers meet them."""

from __future__ import annotations

import ast
import inspect
import re
import shlex
import shutil
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

import megloc_kapture
from megloc_kapture.cli.info import shown
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.pipeline.presets import options_of
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.training.train import DescriptorOptions
from tests.pipeline.runs import run_command

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = sorted([REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")])
NAMES = [str(page.relative_to(REPOSITORY)) for page in PAGES]


def blocks(page: Path, language: str) -> list[str]:
    """Contents of the fenced blocks of a language, '' for those without one."""
    # also blocks of other languages, so that the end of one is not taken for a beginning
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), flags=re.DOTALL | re.M)
    return [content for named, content in fenced if named == language]


def commands(page: Path) -> list[list[str]]:
    lines = "".join(blocks(page, "")).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.startswith("megloc ")]


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub makes of a page's headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.M)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.M)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


EXAMPLES = [example for page in PAGES for example in blocks(page, "python")]


def test_python_examples_name_what_there_is_with_its_arguments() -> None:
    """Check imported names and the arguments of calls, as a type checker does."""
    assert len(EXAMPLES) >= 2
    for example in EXAMPLES:
        result: dict[str, Any] = {}
        for node in ast.walk(ast.parse(example)):
            if isinstance(node, ast.Import | ast.ImportFrom):
                exec(ast.unparse(node), result)  # raises where a name is not there

        def named(node: ast.expr, result: dict[str, Any] = result) -> Any:
            """Return the object of an expression; None if it is not imported."""
            if isinstance(node, ast.Attribute):
                owner = named(node.value)
                return None if owner is None else getattr(owner, node.attr)
            return result.get(node.id) if isinstance(node, ast.Name) else None

        for node in ast.walk(ast.parse(example)):
            called = named(node.func) if isinstance(node, ast.Call) else None
            if str(getattr(called, "__module__", "")).startswith("megloc_kapture"):
                words = {word.arg: None for word in node.keywords if word.arg}
                inspect.signature(called).bind_partial(*node.args, **words)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.M)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?://", target):
            continue
        path, _, anchor = target.partition("#")
        other = (page.parent / path).resolve() if path else page
        assert other.exists(), target
        assert not anchor or anchor in anchors(other), target


def test_every_page_is_reached_from_readme() -> None:
    reached, to_read = set(), [REPOSITORY / "README.md"]
    while to_read:
        page = to_read.pop()
        if page not in reached and page.suffix == ".md":
            reached.add(page)
            result = re.findall(r"\]\(([^)#\s]+\.md)", page.read_text())
            to_read += [(page.parent / one).resolve() for one in result if "://" not in one]
    assert set(PAGES) <= reached


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_files_of_the_repository_that_are_named_exist(page: Path) -> None:
    # the tutorial's package and the scenes lie elsewhere
    elsewhere = ("my_plugins", "redkitchen_rgbd")
    for name in re.findall(r"(?<![\w/])(\w+/[\w/]+\.py)\b", page.read_text()):
        if not name.startswith(elsewhere):
            folders = (REPOSITORY, REPOSITORY / "megloc_kapture")
            assert any((folder / name).is_file() for folder in folders), name


def test_quotes_of_the_paper_are_its_words(shared_data: Path) -> None:
    def words(text: str) -> str:
        text = re.sub(r"~?\\cite\{[^}]*\}|\\cref\{para:global\}", "", text)
        return " ".join(re.sub(r"[$\\{}]", "", text).split())

    paper = shared_data.parent / "reference" / "paper.tex"
    if not paper.is_file():
        pytest.skip("the paper's text is not at hand")
    text = words(paper.read_text())
    page = (REPOSITORY / "docs" / "paper.md").read_text().split("## The paper's rules")[0]
    for row in re.findall(r"^\| (?!step \|).*", page, flags=re.M):
        for quote in re.findall(r'"([^"]+)"', row.strip("| ").split(" | ")[2]):
            for part in re.split(r"\[[^\]]*\]", quote):
                assert part.strip() in text, quote


def test_commands_have_their_options(capsys: pytest.CaptureFixture[str]) -> None:
    known: dict[str, str] = {}
    for page in PAGES:
        for _, *words in commands(page):
            nested = 2 if words[0] in ("weights", "import") else 1
            command = words[:nested]
            name = " ".join(command)
            if name not in known:
                run_command(*command, "--help")
                known[name] = capsys.readouterr().out
            for word in words[nested:]:
                if re.match(r"--?[a-z]", word):
                    assert re.search(rf"{word}\b", known[name]), f"{page.name}: {name} {word}"


def test_every_option_stands_in_the_table_with_its_default() -> None:
    text = (REPOSITORY / "docs" / "options.md").read_text()
    pipeline, of_plugins = text.split("## Options of plugins")
    assert dict(re.findall(r"^\| `([\w.]+)` \| `(.*?)` \|", pipeline, flags=re.M)) == dict(
        (key, shown(value)) for key, value, _ in options_of(PipelineOptions())
    )
    rows = re.findall(r"^\| `(\w+)`, `(\w+)` \| `(.*?)` \|", of_plugins, flags=re.M)
    assert len(rows) > 5
    for plugin, option, default in rows:
        result = [
            one for one in entry_points(name=plugin) if one.group.startswith("megloc_kapture")
        ]
        model = VladOptions if plugin == "vlad" else result[0].load().Options
        assert shown(model.model_fields[option].default) == default, (plugin, option)


def test_every_option_of_training_stands_in_its_table() -> None:
    text = (REPOSITORY / "docs" / "training.md").read_text()
    expected = {key: shown(value) for key, value, _ in options_of(DescriptorOptions())}
    choice = expected.pop("features")
    expected |= {"features.name": choice, "features.options": "{}"}
    assert dict(re.findall(r"^\| `([\w.]+)` \| `(.*?)` \|", text, flags=re.M)) == expected


@pytest.mark.slow
def test_the_stages_one_by_one(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_scene").symlink_to(scene)
    # what needs weights
    absent = ("deeplabv3plus",)
    for _, *words in commands(REPOSITORY / "docs" / "stages.md"):
        if any(word in absent for word in words):
            continue
        inline = [] if words[0] in ("info", "localize", "evaluate") else ["--executor", "inline"]
        run_command(*words, *inline)
    assert "100.0 / 100.0 / 100.0 / 100.0" in capsys.readouterr().out


def test_the_plugins_of_the_tutorial(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = REPOSITORY / "docs" / "plugins.md"
    source, site = tmp_path / "my_plugins", tmp_path / "site"
    source.mkdir()
    (pyproject,), (module,) = blocks(page, "toml"), blocks(page, "python")
    (source / "pyproject.toml").write_text(pyproject)
    (source / "my_plugins.py").write_text(module)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    alone = ["--no-index", "--no-deps", "--no-build-isolation", "--target", str(site)]
    done = subprocess.run([*pip, *alone, str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    shutil.rmtree(source)

    monkeypatch.syspath_prepend(site)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_scene").symlink_to(scene)
    try:
        # the first command uses all plugins of the page
        (_, *words), *_ = commands(page)
        run_command(*words, "--executor", "inline", "--workspace", "run")
        assert "100.0 / 100.0 / 100.0 / 100.0" in capsys.readouterr().out
    finally:
        sys.modules.pop("my_plugins", None)


@pytest.mark.slow
def test_the_api_reference_has_the_public_names_and_no_module_below(tmp_path: Path) -> None:
    script = REPOSITORY / "scripts" / "api_reference.py"
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "does not resolve" not in done.stderr
    page = (tmp_path / "megloc_kapture.html").read_text()
    for name in megloc_kapture.__all__:
        assert f'id="{name}"' in page
    assert 'id="Localizer.localize_many"' in page
    assert {path.stem for path in tmp_path.rglob("*.html")} == {
        *("index", "megloc_kapture", "plugins", "values", "errors")
    }
