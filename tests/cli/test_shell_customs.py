"""What users of command lines are used to: a version, completion, help that is not cut."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from in_process import typed

from crash_coach_bringup.ros.probe import find_executable

ROOT = Path(__file__).resolve().parents[2]


def test_the_version_is_the_packages() -> None:
    done = typed("--version")
    (told,) = re.findall(r"<version>(.*)</version>", (
        ROOT / "ros_ws/src/crash_coach_bringup/package.xml"
    ).read_text())  # fmt: skip
    assert (done.returncode, done.stdout) == (0, f"crash-coach {told}\n")


@pytest.mark.parametrize("words", [[], ["faults"], ["bags"], ["train"], ["evaluate"], ["export"]])
def test_help_is_not_cut(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    done = typed(*words, "--help")
    assert done.returncode == 0
    assert "Commands:" in done.stdout or words not in ([], ["faults"], ["bags"])
    # Where it is cut, "..." stands right behind a word.
    assert not re.findall(r"\w\.\.\.\s*$", done.stdout, flags=re.MULTILINE), done.stdout


@pytest.mark.parametrize(
    ("line", "expected"),
    [("crash-coach check-s", ["check-scenario"]), ("crash-coach export --fo", ["--format"])],
)
def test_the_shell_completes(line: str, expected: list[str]) -> None:
    program = find_executable("crash_coach_bringup", "crash-coach")
    asked = {"_CRASH_COACH_COMPLETE": "complete_bash", "COMP_WORDS": line}
    env = {**os.environ, **asked, "COMP_CWORD": str(line.count(" "))}
    done = subprocess.run([program], env=env, capture_output=True, text=True, timeout=100)
    assert done.stdout.split() == expected, done.stderr


def test_completion_is_installed_for_bash(tmp_path: Path) -> None:
    program = find_executable("crash_coach_bringup", "crash-coach")
    env = {**os.environ, "HOME": str(tmp_path), "SHELL": "/bin/bash"}
    # From a bash: the shell is found among the processes above, and a suite may run without one.
    line = ["bash", "-c", f'"{program}" --install-completion; exit $?']
    done = subprocess.run(line, env=env, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert "crash-coach" in (tmp_path / ".bashrc").read_text()
    (script,) = (tmp_path / ".bash_completions").iterdir()
    assert "_CRASH_COACH_COMPLETE" in script.read_text()
