"""A package that is not ours, installed beside Crash Coach, for the pages on adding things."""

from __future__ import annotations

import configparser
import io
import os
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

from crash_coach_bringup.ros.probe import find_executable

ROOT = Path(__file__).resolve().parents[2]


class Page:
    """A page of docs/ with one block per language: Python of the module at the path that follows
    ``names``, toml of its project, and commands."""

    def __init__(self, name: str, names: str) -> None:
        self.text = (ROOT / "docs" / name).read_text()
        self._names = names

    def block(self, language: str) -> str:
        """The page's only block in that language."""
        (found,) = re.findall(rf"```{language}\n(.*?)```", self.text, flags=re.DOTALL)
        return str(found)

    def installed(self, folder: Path, project: str) -> Path:
        """``folder``, with what installing the project leaves: its module and its metadata."""
        (path,) = re.findall(rf"{self._names}, `(\S+\.py)`", self.text)
        _install(folder, path, self.block("python"), project)
        return folder


def _install(folder: Path, path: str, source: str, project: str) -> None:
    module = folder / path
    module.parent.mkdir(parents=True)
    module.with_name("__init__.py").touch()
    module.write_text(source)
    settings = tomllib.loads(project)["project"]
    info = folder / f"{settings['name'].replace('-', '_')}-{settings['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {settings['name']}\nVersion: {settings['version']}\n"
    )
    points = configparser.ConfigParser()
    points.read_dict(settings["entry-points"])
    text = io.StringIO()
    points.write(text)
    (info / "entry_points.txt").write_text(text.getvalue())


def crash_coach(folder: Path, line: str, *more: str) -> subprocess.CompletedProcess[str]:
    """Types a page's command where the package in ``folder`` is installed."""
    program, *arguments = shlex.split(line)
    command = [str(find_executable("crash_coach_bringup", program)), *arguments, *more]
    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(command, capture_output=True, text=True, timeout=250, env=env)


def refused(folder: Path, line: str) -> str:
    """What a page's command says where it ends with one clear error."""
    done = crash_coach(folder, line)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.split())
