"""A hostile place to work in: one line, whatever the verb."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from in_process import refused

from crash_coach_common import caches
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

START = [sys.executable, "-m", "crash_coach_bringup.cli.start"]


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("policy") / "step_000000000"
    write_untrained(path, make_env("buttons", 1).spec, seed=1)
    return str(path)


def verbs(team: str, at: str) -> dict[str, tuple[str, ...]]:
    """Each verb that writes, writing ``at`` a place that takes nothing."""
    return {
        "train": ("train", "buttons/qmix", "--out", at, "--set", "total_steps=100"),
        "evaluate": ("evaluate", team, "--episodes", "1", "--json", at),
        "calibrate": ("calibrate", "buttons", "--episodes", "1", "--json", at),
        "render": ("render", team, "--out", f"{at}.png"),
        "faults run": ("faults", "run", "one_mute", "--policy", team, "--out", at),
        "faults docs": ("faults", "docs", "--page", at),
        "up": ("up", "buttons", "--policy", team, "--logs", at),
        "inject": ("inject", "--clear", "--json", at),
        "doctor": ("doctor", "--json", at),
        "demo": ("demo", "--out", at),
        "sweep": ("sweep", "paper/table1", "--size", "small", "--out", at),
    }


@pytest.mark.parametrize("verb", verbs("", ""))
def test_a_file_where_a_folder_should_be(tmp_path: Path, team: str, verb: str) -> None:
    (tmp_path / "file").touch()
    said = refused(*verbs(team, str(tmp_path / "file/out"))[verb])
    assert "Traceback" not in said
    assert len(said.strip().splitlines()) == 1
    assert "file" in said


@pytest.mark.parametrize("domain", ["abc", "233", "-1"])
def test_a_domain_that_does_not_exist(monkeypatch: pytest.MonkeyPatch, domain: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    said = refused("inject", "--clear")
    assert domain in said
    assert len(said.strip().splitlines()) == 1


def catches_sigterm(pid: int) -> bool:
    """Python alone catches SIGINT only."""
    status = Path(f"/proc/{pid}/status").read_text()
    (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(mask, 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize("after_s", [0.0, 0.5, pytest.param(3.0, marks=pytest.mark.soak)])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_one_line_at_any_moment(team: str, number: int, after_s: float) -> None:
    """From where our first line has run: while libraries are loaded, at work."""
    command = [*START, "evaluate", team, "--episodes", "100000"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not catches_sigterm(process.pid):
        time.sleep(0.01)
    time.sleep(after_s)
    process.send_signal(number)
    out, said = process.communicate(timeout=250)
    assert process.returncode == 128 + number
    assert said == f"crash-coach: {'interrupted' if number == signal.SIGINT else 'terminated'}\n"
    assert out == ""


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A home and sources that cannot be written to; only the temporary folder can."""
    for name in (*caches.FOLDERS, "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "ROS_HOME"):
        monkeypatch.setenv(name, "")  # else it would not take back what is set where nothing was
        monkeypatch.delenv(name)
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file/home"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(caches.tempfile, "tempdir", str(tmp_path))
    return tmp_path / "file/sources"


def test_caches_find_a_place(nowhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    caches.settle_caches(nowhere)
    base = nowhere.parents[1] / f"crash_coach_{os.getuid()}"
    assert {os.environ[name] for name in caches.FOLDERS} == {
        str(base / folder) for folder in caches.FOLDERS.values()
    }
    assert capsys.readouterr().err.count("\n") == 1
    assert base.stat().st_mode & 0o077 == 0
    caches.settle_caches(nowhere)  # as in every process that is started from here
    assert capsys.readouterr().err == ""
    assert str(base) in caches.places()["numba"]


def test_a_cache_of_somebody_else_is_not_used(
    nowhere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = nowhere.parents[1] / f"crash_coach_{os.getuid()}"
    base.mkdir(mode=0o777)
    base.chmod(0o777)
    caches.settle_caches(nowhere)
    assert "NUMBA_CACHE_DIR" not in os.environ


def test_nothing_is_set_where_all_can_be_written(
    tmp_path: Path, nowhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    caches.settle_caches(tmp_path / "sources")
    assert not any(name in os.environ for name in caches.FOLDERS)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    caches.settle_caches(nowhere)  # sources alone that cannot be written: the home is enough
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "cache/crash_coach/numba")


def test_numba_compiles_without_a_home(nowhere: Path, team: str) -> None:
    env = {**os.environ, "NUMBA_CACHE_DIR": "", "HOME": str(nowhere)}
    done = subprocess.run(
        [*START, "evaluate", team, "--episodes", "1"],
        env=env, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
