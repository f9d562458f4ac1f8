"""docs/adding_an_algorithm.md, followed: its mixer, installed as a package, learns."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from own_package import install
from pydantic import ValidationError

from crash_coach_common.contract import UserError
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.mixer import make_mixer

TESTS = Path(__file__).parents[1]
PAGE = TESTS.parent / "docs/adding_an_algorithm.md"
SIZES = Sizes(n_robots=2, n_actions=3, obs_size=4, state_size=5, episode_limit=6)
LEARN = """
import json, sys
from test_two_step_game import greedy_episode, trained
learner = trained("attention")
arrays, _ = learner.state_dict()
payoff = float(greedy_episode(learner).reward.sum())
print(json.dumps([payoff, sorted(k for k in arrays if k.startswith("online.mixer."))]))
"""


def blocks() -> dict[str, str]:
    """The page's blocks by the file that their first line names."""
    found = re.findall(r"```\w+\n# (\S+)\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return dict(found)


def environment(site: Path) -> dict[str, str]:
    paths = [str(site), str(TESTS / "policy/learner"), str(TESTS / "support")]
    paths.append(os.environ.get("PYTHONPATH", ""))
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def points(text: str) -> str:
    """entry_points.txt of the block of pyproject.toml."""
    group, entries = re.findall(r'\[project\.entry-points\."(.+?)"\]\n(.+)', text, re.DOTALL)[0]
    return f"[{group}]\n" + entries.replace('"', "")


def test_the_pages_mixer_learns_the_two_step_game(tmp_path: Path) -> None:
    files = blocks()
    code = files["my_mixers.py"]
    assert code.count("\n") < 100
    install(tmp_path, points=points(files["pyproject.toml"]))
    (tmp_path / "my_mixers.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "-c", LEARN], env=environment(tmp_path), capture_output=True, timeout=300
    )
    assert done.returncode == 0, done.stderr.decode()
    payoff, parameters = json.loads(done.stdout)
    assert payoff == 8.0
    assert "online.mixer.key" in parameters


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("other = 1", "cannot be loaded"),
        ("class Attention: pass", r"must be a class derived from torch\.nn\.Module"),
        (
            "import torch\nclass Attention(torch.nn.Module): pass",
            r"mixer attention cannot be made from \(sizes, config\)",
        ),
    ],
    ids=["missing", "no module", "arguments"],
)
def test_a_mixer_that_cannot_be_used_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, message: str
) -> None:
    install(tmp_path, points=points(blocks()["pyproject.toml"]))
    (tmp_path / "my_mixers.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_mixers", raising=False)
    with pytest.raises(UserError, match=message):
        make_mixer(LearnerConfig(algorithm="attention"), SIZES)


def test_an_unknown_algorithm_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValidationError, match="unknown algorithm 'qplex'; one of: qmix, vdn, iql"):
        LearnerConfig(algorithm="qplex")


@pytest.mark.skipif(torch.cuda.is_available(), reason="here is a GPU")
def test_a_gpu_that_is_not_there_is_refused() -> None:
    with pytest.raises(UserError, match=r"learner\.device cuda: torch finds no GPU here"):
        Learner(LearnerConfig(device="cuda"), SIZES, seed=0)
