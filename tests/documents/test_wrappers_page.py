"""The programs of docs/wrappers.md, as it says to run them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_the_example_shows_a_rate_that_rises_and_falls() -> None:
    example = ROOT / "examples/crashes_in_your_environment.py"
    done = subprocess.run([sys.executable, example], capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 5
    assert "success 1.00 at crash rate 0.00, crashed 0.00, next crash rate 0.30" in lines[0]
    rates = [float(line.rsplit(" ", 1)[1]) for line in lines]
    assert any(later < before for before, later in pairwise(rates))


def qmix(example: str, *arguments: str) -> list[str]:
    """What an example of a QMIX loop prints of its blocks."""
    command = [sys.executable, ROOT / "examples" / example, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return [line for line in done.stdout.splitlines() if line.startswith("episode ")]


def test_the_qmix_example_runs() -> None:
    lines = qmix("qmix_in_epymarl_style.py", "--episodes", "100")
    assert [line.split(":")[0] for line in lines] == ["episode 0", "episode 100"]


@pytest.mark.soak
@pytest.mark.timeout(1000)
@pytest.mark.parametrize("example", ["qmix_in_epymarl_style.py", "qmix_in_torchrl.py"])
def test_a_qmix_example_learns_while_agents_crash(example: str) -> None:
    """As docs/wrappers.md says."""
    if "torchrl" in example:
        pytest.importorskip("torchrl", reason="make torchrl installs it")
    lines = qmix(example)
    success, rate = (float(lines[-1].split(word)[1].split()[0].rstrip(",")) for word in (
        "success ", "next crash rate "
    ))  # fmt: skip
    assert success > 0.6
    assert rate > 0.1


@pytest.mark.soak
def test_in_a_bare_environment(tmp_path: Path) -> None:
    """Installed by pip, beside PettingZoo and nothing of ours but the common floor."""
    venv, uv = tmp_path / "venv", ROOT / ".venv/bin/uv"
    subprocess.run([uv, "venv", "--quiet", venv], check=True, timeout=120)
    for package in ("ros_ws/src/crash_coach_common", "crash_coach_pkg"):  # pip builds in its source
        shutil.copytree(ROOT / package, tmp_path / Path(package).name)
    packages = [tmp_path / "crash_coach_common", f"{tmp_path / 'crash_coach_pkg'}[wrappers]"]
    python = venv / "bin/python"
    subprocess.run(
        [uv, "pip", "install", "--quiet", "--python", python, *packages], check=True, timeout=600
    )
    script = (ROOT / "examples/crashes_in_your_environment.py").read_text()
    done = subprocess.run(
        [python, "-c", script], cwd=tmp_path, env={"PATH": ""}, capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "crash rate" in done.stdout


def test_the_programs_on_our_scenarios() -> None:
    """docs/wrappers.md, its section on our scenarios."""
    page = (ROOT / "docs/wrappers.md").read_text().split("## Our scenarios for your trainer")[1]
    said = []
    for code in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout)
    assert re.fullmatch(r"(True|False) (True|False) \(\d+, 900, 3\)\n", said[0])
    assert said[1] == "2 8\n"
