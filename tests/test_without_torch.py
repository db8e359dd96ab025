"""Without torch the preset ``classic`` runs, and what needs a network says what to install."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HINT = 'torch is not installed: pip install "megloc-kapture[torch]"'


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Of a process in which torch cannot be imported, as where it is not installed."""
    absent = tmp_path / "absent" / "torch"
    absent.mkdir(parents=True)
    (absent / "__init__.py").write_text(
        "raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')\n"
    )
    return {**os.environ, "PYTHONPATH": str(absent.parent)}


def megloc(
    environment: dict[str, str], *commands: tuple[str | Path, ...], code: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run commands in one process, which prints their statuses last; then Python code."""
    script = (
        "from megloc_kapture.cli.main import main\nstatuses = []\n"
        f"for command in {[list(map(str, command)) for command in commands]!r}:\n"
        "    try:\n        main(command)\n"
        "    except SystemExit as end:\n        statuses.append(end.code)\n"
        f"{code}\nprint(statuses)"
    )
    return subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False
    )


def test_a_network_says_what_to_install(environment: dict[str, str], scene: Path) -> None:
    done = megloc(
        environment,
        ("options", "superpoint"),
        ("eval", "kapture", "--root", scene, "--preset", "modern", "--dry-run"),
        ("doctor",),
    )
    assert done.stdout.endswith("[2, 2, 0]\n"), done
    lines = done.stderr.splitlines()
    assert len(lines) == 2
    assert all(line.startswith("megloc: ") and line.endswith(HINT) for line in lines), lines
    assert HINT in done.stdout


def test_a_map_of_networks_serves_queries_that_bring_their_features(
    environment: dict[str, str], shared_data: Path, tmp_path: Path
) -> None:
    gallery, result = shared_data / "foreign_maps" / "virtual_gallery", tmp_path / "localized"
    queries = ("-i", gallery / "map", "--query", gallery / "query")
    done = megloc(
        environment,
        ("localize", *queries, "-o", result, "--quiet"),
        ("evaluate", "-i", result, "--gt", gallery / "query_gt", "--thresholds", "0.05,5"),
        code=(
            "import megloc_kapture as megloc\n"
            f"image_map = megloc.open_map({str(gallery / 'map')!r})\n"
            f"results = image_map.localize({str(gallery / 'query')!r})\n"
            "assert len(results) == 4 and all(results.values()), dict(results)\n"
            "from megloc_kapture.service.app import make_app\n"
        ),
    )
    assert done.stdout.endswith("[0, 0]\n") and "100.0" in done.stdout, done


@pytest.mark.slow
def test_classic_runs(environment: dict[str, str], scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    done = megloc(
        environment,
        ("eval", "kapture", "--root", scene, "--workspace", run, "--quiet"),
        ("localize", "-i", run / "map", "--query", scene / "query", "-o", tmp_path / "localized"),
    )
    assert done.stdout.endswith("[0, 0]\n"), done
    assert "100.0 / 100.0 / 100.0 / 100.0" in done.stdout
    assert "4 of 4 queries localized" in done.stdout
