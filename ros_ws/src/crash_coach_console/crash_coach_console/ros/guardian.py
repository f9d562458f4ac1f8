"""Clears every fault of a graph when the console that started it is gone, however that ended.

A process of its own, whose standard input the console keeps open: that it closes needs no signal.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

from std_srvs.srv import Trigger

from crash_coach_common.contract import UserError
from crash_coach_console.ros.graph_link import ANSWER_S, GraphLink, Silent

STARTED_S = 30.0
FOUND_S = 3.0
"""How long a coach is looked for at the end."""
LOOK_S = 0.1
CLEARED = "cleared"


class Guardian:
    """Of the graph on ``domain`` under ``namespace``."""

    def __init__(self, domain: int, namespace: str) -> None:
        module = [sys.executable, "-m", "crash_coach_console.ros.guardian"]
        self._child = subprocess.Popen(
            [*module, str(domain), namespace],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # a Ctrl-C is the console's
        )

    def close(self) -> None:
        """Lets it do its work. Raises UserError where it does not say that it did."""
        try:
            said, _ = self._child.communicate(timeout=STARTED_S + ANSWER_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            said = "it did not answer"
        if said.strip() != CLEARED:
            raise UserError(f"faults may still be in force: {said.strip()}")


def guard(domain: int, namespace: str) -> str:
    """Waits for the end of standard input; then clears, and says what came of it.

    Where there is no coach, the gate has cleared when the coach's lease ran out.
    """
    link = GraphLink(Silent(), domain, namespace, listen=False)
    link.start()
    try:
        while os.read(sys.stdin.fileno(), 1024):
            pass
        until_s = time.monotonic() + FOUND_S
        while not link.ready("clear_all"):
            if time.monotonic() > until_s:
                return CLEARED
            time.sleep(LOOK_S)
        answer = link.call("clear_all", Trigger.Request()).result()
    except TimeoutError as error:
        return str(error)
    finally:
        link.stop()
    return CLEARED if answer.success else str(answer.message)


def main() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    print(guard(int(sys.argv[1]), sys.argv[2]), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
