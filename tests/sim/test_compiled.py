"""Compiled code: what is kept of it must be of today's sources."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HELPER = """
from sim_pkg.compiled import helper
ADDED = 1

@helper
def more(numbers):
    numbers[0] += {added}
"""
ENTRY = """
import numpy as np
from sim_pkg.compiled import entry
from other import ADDED, more

@entry
def count(numbers):
    more(numbers)
    return numbers[0] + ADDED

print(count(np.zeros(1)), sum(count.stats.cache_hits.values()))
"""


def test_code_is_kept_until_a_file_of_its_package_changes(tmp_path: Path) -> None:
    (tmp_path / "main.py").write_text(ENTRY)

    def run(helper: str) -> list[str]:
        (tmp_path / "other.py").write_text(helper)
        done = subprocess.run(
            [sys.executable, "main.py"],
            # Python would take bytecode of the same second and length for today's.
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
            cwd=tmp_path,
            check=True,
            capture_output=True,
            text=True,
        )
        return done.stdout.split()

    assert run(HELPER.format(added=1)) == ["2.0", "0"]
    assert run(HELPER.format(added=1)) == ["2.0", "1"]
    changed = HELPER.format(added=2).replace("ADDED = 1", "ADDED = 5")
    assert run(changed) == ["7.0", "0"]  # of one change alone it would be 6 or 3


@pytest.mark.parametrize("module", ["sim_pkg.compiled", "policy_pkg.learner.replay"])
def test_others_compile_with_scipy_as_before(module: str) -> None:
    """It is not loaded with the simulator or the trainer, only for who uses it."""
    code = (
        "import importlib.util, sys, numpy as np\n"
        f"import {module}\n"
        "from numba import njit\n"
        "print('scipy.linalg' in sys.modules or 'coverage' in sys.modules)\n"
        "importlib.util.find_spec('coverage')\n"
        "try:\n"
        "    import scipy\n"
        "except ImportError:\n"
        "    print('absent')\n"
        "else:\n"
        "    print(njit(lambda a, b: np.dot(a, b))(np.ones(3), np.ones(3)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() in (["False", "3.0"], ["False", "absent"])
