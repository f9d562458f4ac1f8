"""The commands of docs/pettingzoo.md, on mpe2; shortened but for `make soak`."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from in_process import typed

PAGE = Path(__file__).resolve().parents[2] / "docs" / "pettingzoo.md"


def commands() -> list[str]:
    blocks = re.findall(r"```bash\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    return [line.removeprefix("crash-coach ") for block in blocks for line in block.splitlines()]


def scenario_file() -> str:
    (block,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    return str(block)


def run_page(folder: Path, short: bool) -> None:
    """Types what the page says in ``folder``, and looks at what it leaves."""
    for line in commands():
        if short:
            line = re.sub("[24]0000", "600", line).replace("--episodes 64", "--episodes 2")
            line += " test_episodes=2 n_envs=4" if line.startswith("train ") else ""
        done = typed(*shlex.split(line))
        assert done.returncode == 0, done.stdout + done.stderr
    for film in ("spread", "pursuit"):
        assert (folder / f"runs/{film}.mp4").stat().st_size > 10_000
    assert "simple_spread_v3" in (folder / "runs/spread_report/table.md").read_text()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("mpe2", reason="make environments installs it")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.timeout(500)
def test_the_commands(folder: Path) -> None:
    run_page(folder, short=True)


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_the_commands_in_their_size_teach_something(folder: Path) -> None:
    run_page(folder, short=False)
    (folder / "spread.yaml").write_text(scenario_file())
    returns = {}
    for team in ("runs/spread", "scripted:random"):
        out = folder / "result.json"
        done = typed("evaluate", team, "--scenario", "spread.yaml", "--json", str(out))
        assert done.returncode == 0, done.stderr
        returns[team] = json.loads(out.read_text())["conditions"][0]["return_mean"]
    assert returns["runs/spread"] > returns["scripted:random"] + 5
    out = folder / "pursuit.json"
    assert typed("evaluate", "runs/pursuit", "--json", str(out)).returncode == 0
    assert json.loads(out.read_text())["conditions"][0]["success_rate"] > 0.5


def test_the_file_is_the_same_scenario(folder: Path) -> None:
    (folder / "spread.yaml").write_text(scenario_file())
    results = []
    for scenario in ("spread.yaml", "other.yaml"):
        (folder / "other.yaml").write_text(
            "kind: pettingzoo\nenvironment: mpe2.simple_spread_v3:parallel_env\nstay_action: 0\n"
        )
        done = typed("evaluate", "scripted:random", "--scenario", scenario, "--episodes", "2")
        assert done.returncode == 0, done.stderr
        results.append(done.stdout)
    assert "%" in results[0]
    assert "not told" in results[1]
