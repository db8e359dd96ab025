"""One finished run of ours that the interop tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
from kloc import megloc


@pytest.fixture(scope="session")
def fountain_workspace(fountain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the scene with the default preset; tests must not write into it."""
    workspace = tmp_path_factory.mktemp("fountain") / "workspace"
    megloc("eval", "kapture", "--root", fountain, "--workspace", workspace)
    return workspace
