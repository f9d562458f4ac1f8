"""The supervisor, with plain processes: deaths, stopping, nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from crash_coach_bringup.ros.graph import Process
from crash_coach_bringup.ros.supervisor import Ended, Event, Supervisor, watch

STUBBORN = "import signal, time; [signal.signal(s, signal.SIG_IGN) for s in (2, 15)]; "
SLEEP = "import time; print('up', flush=True); time.sleep(60)"


def python(name: str, code: str) -> Process:
    return Process(name, (sys.executable, "-c", code))


def gone(pids: list[int]) -> bool:
    return not any(psutil.pid_exists(pid) for pid in pids)


def await_text(path: Path, text: str) -> None:
    deadline = time.monotonic() + 10
    while text not in path.read_text():
        assert time.monotonic() < deadline, f"{text!r} did not appear in {path}"
        time.sleep(0.01)


def wait_for_end(supervisor: Supervisor) -> Ended:
    (ended,) = supervisor.wait(10)
    return ended


def test_a_death_is_told_with_code_and_the_end_of_the_log(tmp_path: Path) -> None:
    failing = "print(*range(100), sep='\\n'); print('the reason'); raise SystemExit(3)"
    with Supervisor([python("a", SLEEP), python("b", failing)], tmp_path, {}) as supervisor:
        pids = list(supervisor.pids().values())
        ended = wait_for_end(supervisor)
    assert (ended.name, ended.exit_code, ended.log) == ("b", 3, tmp_path / "b.log")
    assert ended.tail.endswith("98\n99\nthe reason")
    assert len(ended.tail.splitlines()) < 20
    assert "b died (exit code 3" in ended.describe()
    assert gone(pids)


def test_a_killed_process_is_told_by_its_signal(tmp_path: Path) -> None:
    with Supervisor([python("a", SLEEP)], tmp_path, {}) as supervisor:
        os.kill(supervisor.pids()["a"], signal.SIGKILL)
        ended = wait_for_end(supervisor)
    assert "a died (killed by SIGKILL" in ended.describe()


def test_stopping_asks_first_and_kills_what_does_not_listen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    polite = (
        "import signal, time; signal.signal(2, lambda *_: (print('bye'), exit(0)));"
        "print('up', flush=True); time.sleep(60)"
    )
    stops = ((signal.SIGINT, 0.5), (signal.SIGTERM, 0.2), (signal.SIGKILL, 5.0))
    monkeypatch.setattr("crash_coach_bringup.ros.supervisor.STOPS", stops)
    processes = [python("polite", polite), python("stubborn", STUBBORN + SLEEP)]
    with Supervisor(processes, tmp_path, {}) as supervisor:
        pids = list(supervisor.pids().values())
        for name in ("polite", "stubborn"):
            await_text(supervisor.log_of(name), "up")
    assert gone(pids)
    assert (tmp_path / "polite.log").read_text() == "up\nbye\n"


def test_a_failing_start_leaves_nothing_behind(tmp_path: Path) -> None:
    before = set(psutil.Process().children())
    processes = [python("a", SLEEP), Process("b", ("/no/such/program",))]
    with pytest.raises(FileNotFoundError, match="/no/such/program"):
        Supervisor(processes, tmp_path, {}).__enter__()
    assert set(psutil.Process().children()) == before


def test_a_killed_supervisor_takes_its_processes_along(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path;"
        "from crash_coach_bringup.ros.graph import Process;"
        "from crash_coach_bringup.ros.supervisor import Supervisor;"
        f"sleeper = Process('a', (sys.executable, '-c', {STUBBORN + SLEEP!r}));"
        f"s = Supervisor([sleeper], Path({str(tmp_path)!r}), {{}});"
        "s.__enter__(); print(s.pids()['a'], flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        pid = int(child.stdout.readline())
        await_text(tmp_path / "a.log", "up")
        child.kill()
    deadline = time.monotonic() + 5
    while psutil.pid_exists(pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not psutil.pid_exists(pid)


@pytest.mark.parametrize(
    ("sim", "code", "kind"),
    [("pass", 0, "finished"), ("raise SystemExit(1)", 1, "died")],
)
def test_the_sim_ends_the_graph(tmp_path: Path, sim: str, code: int, kind: str) -> None:
    events: list[Event] = []
    with Supervisor([python("a", SLEEP), python("sim", sim)], tmp_path, {}) as supervisor:
        assert watch(supervisor, ("sim",), lambda: False, events.append) == code
    assert [event.kind for event in events] == [kind]


def test_another_process_that_ends_is_a_death_even_with_code_0(tmp_path: Path) -> None:
    events: list[Event] = []
    with Supervisor([python("a", "pass"), python("sim", SLEEP)], tmp_path, {}) as supervisor:
        assert watch(supervisor, ("sim",), lambda: False, events.append) == 1
    assert [event.process for event in events] == ["a"]


def test_an_interruption_ends_watching(tmp_path: Path) -> None:
    events: list[Event] = []
    with Supervisor([python("sim", SLEEP)], tmp_path, {}) as supervisor:
        assert watch(supervisor, ("sim",), lambda: True, events.append) == 130
    assert [event.kind for event in events] == ["interrupted"]
