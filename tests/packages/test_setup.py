"""The set-up script: what it refuses and why, stages that resume, the wheels' rewritten paths."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def setup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script as a module whose environment is an empty folder."""
    spec = importlib.util.spec_from_file_location("setup_script", ROOT / "scripts" / "setup.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "VENV", tmp_path)
    monkeypatch.setattr(module, "STAMPS", tmp_path / "stamps")
    return module


def test_a_second_set_up_does_nothing_and_is_quick() -> None:
    start = time.monotonic()
    done = subprocess.run(
        [sys.executable, "scripts/setup.py"], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr
    assert time.monotonic() - start < 10  # it takes well under a second


def test_another_distribution_is_refused(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DISTRO", "humble")
    with pytest.raises(setup.SetupError, match=r"humble.*jazzy"):
        setup.underlay()


def test_what_the_machine_lacks_is_named(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(setup, "DISK_BYTES", 10**18)
    with pytest.raises(setup.SetupError, match="GB free"):
        setup.check_machine()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(setup.SetupError, match=r"compiler.*build-essential"):
        setup.check_machine()


def test_an_old_python_is_refused_with_its_version(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    old = tmp_path / "old_python"
    old.write_text("#!/bin/sh\necho 3 9\n")
    old.chmod(0o755)
    monkeypatch.setenv("PYTHON", str(old))
    with pytest.raises(setup.SetupError, match=r"no Python 3\.11 to 3\.14 found .*is 3\.9"):
        setup.find_python("wheels")
    monkeypatch.setenv("PYTHON", str(tmp_path / "none"))
    with pytest.raises(setup.SetupError, match="none runs"):
        setup.find_python("wheels")


@pytest.mark.parametrize(("version", "fits"), [("3 11", False), ("3 12", True), ("3 13", False)])
def test_a_distribution_takes_the_python_that_it_is_built_for(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, version: str, fits: bool
) -> None:
    python = tmp_path / "some_python"
    python.write_text(f"#!/bin/sh\necho {version}\n")
    python.chmod(0o755)
    monkeypatch.setenv("PYTHON", str(python))
    assert setup.find_python("wheels") == str(python)
    if fits:
        assert setup.find_python("distribution") == str(python)
        return
    reason = r"no Python 3\.12, which the sourced Jazzy distribution is built for, found"
    with pytest.raises(setup.SetupError, match=reason):
        setup.find_python("distribution")


def test_an_interrupted_stage_is_done_again(setup: ModuleType) -> None:
    calls: list[str] = []

    def interrupted() -> None:
        calls.append("interrupted")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        setup.stage("one", "one", "v1", interrupted)
    setup.stage("one", "one", "v1", lambda: calls.append("whole"))
    setup.stage("one", "one", "v1", lambda: calls.append("not again"))
    setup.stage("one", "one", "v2", lambda: calls.append("changed"))
    assert calls == ["interrupted", "whole", "changed"]


def test_failure_shows_the_end_of_the_log(setup: ModuleType, tmp_path: Path) -> None:
    log = tmp_path / "log" / "x.log"
    with pytest.raises(setup.SetupError, match="the reason"):
        setup.run(["sh", "-c", "echo the reason; exit 3"], log)
    assert log.read_text() == "the reason\n"


def test_rewriting_leaves_the_package_cache_alone(
    setup: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(setup, "PYTHON", Path(sys.executable))
    cached = tmp_path / "cache.cmake"
    cached.write_text(
        'set(a "/opt/python/cp311-cp311/include/python3.11")\n'
        'set(b "/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include")\n'
        'set(c "/opt/python/cp311-cp311/lib")\n'
    )
    before = cached.read_text()
    (tmp_path / "share").mkdir()
    installed = tmp_path / "share" / "x.cmake"
    os.link(cached, installed)  # as uv installs
    assert setup.rewrite_cmake_paths() == 1
    assert cached.read_text() == before
    paths = [line.split('"')[1] for line in installed.read_text().splitlines()]
    assert paths[2] == f"{tmp_path}/lib"
    assert (Path(paths[0]) / "Python.h").exists()
    assert (Path(paths[1]) / "numpy" / "arrayobject.h").exists()
    assert setup.rewrite_cmake_paths() == 0


def test_env_without_set_up_says_what_to_do(tmp_path: Path) -> None:
    shutil.copy(ROOT / "env.sh", tmp_path)
    done = subprocess.run(
        ["bash", "-c", f". {tmp_path}/env.sh"], capture_output=True, text=True, timeout=30
    )
    assert done.returncode == 1
    assert "make setup" in done.stderr
