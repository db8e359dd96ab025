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


def megloc(environment: dict[str, str], *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    code = "from megloc_kapture.cli.main import main; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_a_network_says_what_to_install(environment: dict[str, str], scene: Path) -> None:
    for arguments in (
        ("options", "superpoint"),
        ("eval", "kapture", "--root", scene, "--preset", "modern", "--dry-run"),
    ):
        done = megloc(environment, *arguments)
        assert done.returncode == 2
        assert done.stderr.startswith("megloc: ") and done.stderr.endswith(f"{HINT}\n")
        assert done.stderr.count("\n") == 1
    assert HINT in megloc(environment, "doctor").stdout


def test_a_map_of_networks_serves_queries_that_bring_their_features(
    environment: dict[str, str], shared_data: Path, tmp_path: Path
) -> None:
    gallery = shared_data / "foreign_maps" / "virtual_gallery"
    queries = ("-i", gallery / "map", "--query", gallery / "query")
    done = megloc(environment, "localize", *queries, "-o", tmp_path / "localized", "--quiet")
    assert done.returncode == 0, done.stderr
    result = ("-i", tmp_path / "localized", "--gt", gallery / "query_gt", "--thresholds", "0.05,5")
    done = megloc(environment, "evaluate", *result)
    assert "100.0" in done.stdout, done.stdout + done.stderr
    opens = (
        "import megloc_kapture as megloc\n"
        f"m = megloc.open_map({str(gallery / 'map')!r})\n"
        f"found = m.localize({str(gallery / 'query')!r})\n"
        "assert len(found) == 4 and all(found.values()), dict(found)\n"
        "from megloc_kapture.service.app import make_app\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", opens], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_classic_runs(environment: dict[str, str], scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    done = megloc(environment, "eval", "kapture", "--root", scene, "--workspace", run, "--quiet")
    assert done.returncode == 0, done.stderr
    assert "100.0 / 100.0 / 100.0 / 100.0" in done.stdout
    asked = megloc(
        environment,
        *("localize", "-i", run / "map", "--query", scene / "query"),
        *("-o", tmp_path / "localized"),
    )
    assert asked.stdout.startswith("4 of 4 queries localized"), asked.stderr
