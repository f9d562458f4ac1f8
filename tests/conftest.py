"""Shared fixtures. ROS tests get a domain of their own and stay on this machine."""

from __future__ import annotations

import faulthandler
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from shared_memory import remove_left_behind

from crash_coach_bringup.ros import discovery
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_common.caches import FOLDERS
from crash_coach_common.loading import loading

# Where the suite runs in the background of a shell, Ctrl-C is ignored, by all that it starts too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

WAITING = [Path(__file__).parent / room for room in ("ros", "console")]

# How long an example takes says how busy the machine is.
settings.register_profile("here", deadline=None)
settings.load_profile("here")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that mostly wait, for graphs and pages, spread between files that compute."""
    files = list(dict.fromkeys(item.path for item in items))
    waiting = [path for path in files if any(map(path.is_relative_to, WAITING))]
    computing = [path for path in files if path not in waiting]
    at = {path: i / len(computing) for i, path in enumerate(computing)}
    # A bit ahead: nobody should wait at the end.
    at |= {path: 0.85 * i / len(waiting) for i, path in enumerate(waiting)}
    items.sort(key=lambda item: at[item.path])


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    with loading():
        return (yield)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: object) -> None:
    """Says how a worker of pytest-xdist died: it tells only that one did."""
    if error is None:
        return
    try:
        code = node.gateway._io.popen.wait(timeout=10)
    except subprocess.TimeoutExpired:
        how = "it runs on, its pipe is closed"
    else:
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    print(f"\n[{node.gateway.id}] how it ended: {how}", file=sys.stderr)


def pytest_sessionstart(session: pytest.Session) -> None:
    if not hasattr(session.config, "workerinput"):  # once, before pytest-xdist's workers
        remove_left_behind()


@pytest.fixture(scope="session", autouse=True)
def told_crashes() -> Iterator[None]:
    """rclpy's executor has crashes told on a stderr that is captured by then: nobody saw them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(faulthandler, "enable", lambda *_, **__: None)  # pytest's own stays
        yield


@pytest.fixture(scope="session", autouse=True)
def environment() -> Iterator[None]:
    """What a test leaves behind here reaches all tests after it, and what they start.

    Of numba's folder, for one: every process compiled the simulator anew.
    """
    names = (*FOLDERS, "HOME", "PYTHONPATH", "ROS_DOMAIN_ID", "TMPDIR", "XDG_CACHE_HOME")
    before = {name: os.environ.get(name) for name in names}
    yield
    assert {name: os.environ.get(name) for name in names} == before


@pytest.fixture
def ros_env(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """The environment for a test's ROS processes; also set for this process."""
    with reserve_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setenv(discovery.VARIABLE, discovery.profiles_file())
        yield dict(os.environ)
