"""A package from outside the repository: a scenario kind, a coaching strategy, a fault mode, a
mixer and an experiment logger, each of them an entry point."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

SOURCE = '''
from typing import Literal

import numpy as np
from pydantic import Field

from crash_coach_pkg.coach.strategies.by_rate import MovingRate
from crash_coach_pkg.faults.base import CommandFault, FaultParameters
from sim_pkg.scenarios.base import Kind
from sim_pkg.scenarios.buttons import Buttons, ButtonsConfig


class PatrolConfig(ButtonsConfig):
    kind: Literal["patrol"]
    reward_company: float


class Patrol(Buttons):
    """Buttons, and a reward for every step in which two robots share a cell."""

    def settle(self, running, world, out):
        super().settle(running, world, out)
        cells = np.floor(world.bodies[:, : self.spec.n_robots, :2] / self.config.cell_m)
        together = (cells[:, 0] == cells[:, 1]).all(axis=-1)
        out.reward[running & together] += self.config.reward_company


KIND = Kind(PatrolConfig, Patrol)


class Steady(MovingRate):
    """A rate that follows the number of episodes."""

    name = "steady"
    summary = "A quarter crashes in the first episode, then half."
    _rate = 0.25

    def episode_over(self, over):
        self._rate = 0.5


class LimpParameters(FaultParameters):
    every: int = Field(
        default=2,
        ge=1,
        le=100,
        description="Every so many commands one is lost.",
        json_schema_extra={"unit": "commands"},
    )


class Limp(CommandFault):
    name = "limp"
    code = 201
    summary = "Every few commands one is lost."
    Parameters = LimpParameters

    def __init__(self, parameters):
        super().__init__(parameters)
        self._count = 0

    def apply(self, step, command, last, tools):
        self._count += 1
        return None if self._count % self.parameters.every == 0 else command
'''

MIXERS = '''
from torch import nn

from policy_pkg.learner.layers import Linear


class Weighted(nn.Module):
    """Q_tot = sum_i |w_i(s)| q_i + V(s)."""

    def __init__(self, sizes, config):
        super().__init__()
        self.weigh = Linear(sizes.state_size, sizes.n_robots)
        self.value = Linear(sizes.state_size, 1)

    def forward(self, values, state):
        return (self.weigh(state).abs() * values).sum(1) + self.value(state).squeeze(1)
'''
LOGGERS = '''
from crash_coach_common.strict_yaml import StrictModel
from policy_pkg.train.loggers.base import ExperimentLogger


class DiaryOptions(StrictModel):
    title: str


class Diary(ExperimentLogger):
    """A line of text per block."""

    Options = DiaryOptions

    def __init__(self, start, options):
        self._path = start.out_dir / "diary.txt"
        hidden, commit = start.settings["learner.hidden"], "commit" in start.about
        self._note(f"{options.title}: from step {start.step}, hidden {hidden}, commit {commit}")

    def _note(self, text):
        with open(self._path, "a", encoding="utf-8") as file:
            file.write(text + "\\n")

    def log_metrics(self, line, step):
        if line["env_steps"] == 200:
            raise OSError("no ink")
        self._note(f"{step}: {line['success_rate']}")

    def finalize(self, status):
        self._note(status)
'''
POINTS = """
[crash_coach.scenarios]
patrol = own:KIND

[crash_coach.strategies]
steady = own:Steady

[crash_coach.faults]
limp = own:Limp

[crash_coach.mixers]
weighted = own_mixers:Weighted

[crash_coach.loggers]
diary = own_loggers:Diary
"""
PROJECT = """
[project]
name = "own-robots"
version = "1.0"

[tool.setuptools]
py-modules = ["own", "own_loggers", "own_mixers"]
"""


def install_really(source: Path, site: Path) -> None:
    """The package's project in ``source``, built and installed into ``site`` by an installer."""
    source.mkdir()
    (source / "own.py").write_text(SOURCE)
    (source / "own_mixers.py").write_text(MIXERS)
    (source / "own_loggers.py").write_text(LOGGERS)
    points = POINTS.replace("[", '[project.entry-points."').replace("]", '"]')
    quoted = re.sub(r"(?m)^(\w+) = (.+)$", r'\1 = "\2"', points)
    (source / "pyproject.toml").write_text(PROJECT + quoted)
    uv = str(Path(sys.executable).with_name("uv"))
    options = ["--no-deps", "--no-build-isolation", "--offline", "--target", str(site)]
    command = [uv, "pip", "install", "--python", sys.executable, *options, str(source)]
    subprocess.run(command, check=True, capture_output=True, timeout=100)


def install(site: Path, source: str = SOURCE, points: str = POINTS) -> None:
    """What installing the package leaves in ``site``: its module, and what its metadata says."""
    info = site / "own_robots-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "own.py").write_text(source)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-robots\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)
