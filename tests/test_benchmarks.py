"""`make bench` runs to its end; what it measures is for a reader on an idle machine."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.soak
def test_every_benchmark_runs(tmp_path: Path) -> None:
    out = tmp_path / "bench.json"
    command = [sys.executable, "-m", "benchmarks", "--out", str(out)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=3000, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads(out.read_text())
    assert all({"name", "value", "unit", "ratio", "target", "ok"} <= set(row) for row in rows)
    # A benchmark each: only the browser's may be left out, where there is none.
    assert len({row["name"] for row in rows}) == len(rows) > 40
