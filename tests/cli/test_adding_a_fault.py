"""docs/adding_a_fault.md, followed to the letter: a mode of a package that is not ours."""

from __future__ import annotations

import configparser
import io
import json
import os
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest

from crash_coach_bringup.ros.probe import find_executable

PAGE = (Path(__file__).resolve().parents[2] / "docs/adding_a_fault.md").read_text()


def block(language: str) -> str:
    """The page's only block in that language."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)
    return str(found)


def install(folder: Path, project: str) -> None:
    """What installing the project leaves: its modules, and what its metadata says."""
    (path,) = re.findall(r"The mode, `(\S+\.py)`", PAGE)
    module = folder / path
    module.parent.mkdir(parents=True)
    module.with_name("__init__.py").touch()
    module.write_text(block("python"))
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
    """Types the page's command where the package in ``folder`` is installed."""
    program, *arguments = shlex.split(line)
    command = [str(find_executable("crash_coach_bringup", program)), *arguments, *more]
    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(command, capture_output=True, text=True, timeout=90, env=env)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    install(folder, block("toml"))
    return folder


def hash_of(folder: Path, line: str, out: Path) -> str:
    done = crash_coach(folder, line, "--json", str(out))
    assert done.returncode == 0, done.stderr
    return str(json.loads(out.read_text())["conditions"][0]["trajectory_hash"])


def test_the_mode_works_as_the_page_says(package: Path, tmp_path: Path) -> None:
    line = block("bash").strip()
    frozen = line.replace("--mode hiccup --param period=2", "--mode freeze")
    lines = line, line.replace("period=2", "period=1"), frozen
    as_written, each_step, freeze = (
        hash_of(package, text, tmp_path / f"{i}.json") for i, text in enumerate(lines)
    )
    assert as_written != each_step
    assert each_step == freeze  # from the first step on, nothing new is taken


def test_its_schema_is_checked(package: Path) -> None:
    done = crash_coach(package, block("bash").strip().replace("period=2", "period=0"))
    assert done.returncode != 0
    assert "hiccup: parameter period = 0" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def test_without_the_package_the_mode_is_unknown(tmp_path: Path) -> None:
    done = crash_coach(tmp_path, block("bash").strip())
    assert done.returncode != 0
    assert "unknown crash mode 'hiccup'" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("hiccup:Hiccup", "hiccup:Hicup", "has no attribute 'Hicup'"),
        ("hiccup:Hiccup", "hiccup:HiccupParameters", "neither a CommandFault nor"),
    ],
)
def test_a_broken_entry_point_is_named(tmp_path: Path, old: str, new: str, text: str) -> None:
    install(tmp_path / "site", block("toml").replace(old, new))
    done = crash_coach(tmp_path / "site", block("bash").strip())
    assert done.returncode != 0
    said = " ".join(done.stderr.split())
    assert "entry point hiccup" in said
    assert "my-faults" in said
    assert text in said
    assert "Traceback" not in done.stderr
