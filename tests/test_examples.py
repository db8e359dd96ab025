"""The scripts and the notebook in examples/ do what they say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(code: list[str | Path], place: Path) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, code)], cwd=place, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_map_and_evaluate_then_photographs(scene: Path, tmp_path: Path) -> None:
    output = run([EXAMPLES / "map_and_evaluate.py", scene], tmp_path)
    assert output.count(".jpg: ") == 4 and "100.0 / 100.0 / 100.0 / 100.0" in output
    assert (tmp_path / "example_report.html").is_file()
    assert (tmp_path / "example_scene.ply").stat().st_size > 1000
    photographs = sorted((scene / "query/sensors/records_data").glob("*.jpg"))
    output = run(
        [EXAMPLES / "localize_photographs.py", tmp_path / "example_run/map", *photographs], tmp_path
    )
    assert output.count("confidence") == 4, output


@pytest.mark.slow
def test_compare_presets(scene: Path, tmp_path: Path) -> None:
    output = run([EXAMPLES / "compare_presets.py", scene], tmp_path)
    assert "8 candidates" in output and "1 candidate" in output


@pytest.mark.slow
def test_the_notebook(scene: Path, tmp_path: Path) -> None:
    """Its cells one after another, as a kernel runs them."""
    cells = json.loads((EXAMPLES / "first_steps.ipynb").read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    (tmp_path / "my_scene").symlink_to(scene)
    (tmp_path / "notebook.py").write_text(code)
    output = run([tmp_path / "notebook.py"], tmp_path)
    assert "100.0 / 100.0 / 100.0 / 100.0" in output and (tmp_path / "report.html").is_file()
