"""`crash-coach export`, and what docs/export.md has to type and to run."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from in_process import refused, typed

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/export.md"
TEAM = ROOT / "results/recipe/robust/robust-s0"


def block(language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    return str(found)


def test_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commands, then its program with what they left."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results").symlink_to(ROOT / "results")
    said = []
    for line in block("bash").splitlines():
        done = typed(*shlex.split(line)[1:])
        assert done.returncode == 0, done.stderr
        said.append(done.stdout)
    assert "wrote exported/onnx/policy.onnx" in said[0]
    assert "in 1,000 steps: action values 0.0e+00, hidden state 0.0e+00" in said[1]
    assert "100.0 %" in said[3]
    code = [sys.executable, "-W", "ignore", "-c", block("python")]
    ran = subprocess.run(code, capture_output=True, text=True, timeout=250)
    assert ran.returncode == 0, ran.stderr
    names = r"'(up|down|left|right|stay)'"
    assert re.fullmatch(rf"\[{names}, {names}\]\n", ran.stdout), ran.stdout


def test_the_table_is_what_policy_json_says(tmp_path: Path) -> None:
    done = typed("export", str(TEAM), "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    about = (tmp_path / "out/policy.json").read_text()
    rows = re.findall(r"^\| `(\w+)` \| \(rows", PAGE.read_text(), flags=re.MULTILINE)
    assert rows == re.findall(r'"name": "(\w+)"', about)


def test_refusals(tmp_path: Path) -> None:
    assert "is a scripted team" in refused("export", "scripted:kite")
    assert "no such file or directory" in refused("export", str(tmp_path / "nothing"))
    assert "is there already" in refused("export", str(TEAM), "--out", str(ROOT / "docs"))
    assert "onnx" in refused("export", str(TEAM), "--format", "h5")


def test_a_team_whose_environment_is_not_installed_has_no_names_of_actions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(TEAM, tmp_path / "run", ignore=shutil.ignore_patterns("run.json"))
    (manifest,) = (tmp_path / "run/checkpoints").glob("*/checkpoint.json")
    about = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**about, "scenario": "pettingzoo:not_there.envs:make"}))
    done = typed("export", str(tmp_path / "run"), "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    assert "policy.json will have no names of actions" in done.stdout
    assert json.loads((tmp_path / "out/policy.json").read_text())["action_names"] is None
