"""The smoke script of the GPU path, on the processor."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_every_step_succeeds_on_the_processor() -> None:
    script = Path(__file__).parents[2] / "benchmarks" / "gpu_smoke.py"
    command = [sys.executable, str(script), "--device", "cpu"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
