"""Several nodes of the graph in one process, on one executor:
``python -m crash_coach_bringup.ros.composed NODE ... --ros-args ...``.

Parameters of a node are given as ``-p <node>:<name>:=<value>``; graph.composed_process builds the
command line. Only the coach's parameter services run in a thread of their own, as they always do.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import sys
from functools import partial
from typing import Any

from crash_coach_common.contract import UserError
from crash_coach_common.ros.run_node import Serving, run, serving

# Loaded where they run: a process of gate and sim needs no policies.
_STARTED = {"gate": "crash_coach_pkg.ros.gate_node", "coach": "crash_coach_pkg.ros.coach_node"}
_NODES = {
    "team": ("policy_pkg.ros.team_node", "TeamNode"),
    "sim": ("sim_pkg.ros.sim_node", "SimNode"),
}

_OF_NODE = re.compile(r"(?P<node>\w+):(?P<name>[\w./]+):=(?P<value>.*)", re.DOTALL)


def main() -> int:
    """The exit code: 0 after the last episode or a signal, 1 after one line of error."""
    begin = sys.argv.index("--ros-args")
    names = sys.argv[1:begin]
    sys.argv[1:] = in_namespace(sys.argv[begin:])
    return run(partial(_run, names), "graph" if "team" in names else "sim")


def in_namespace(arguments: list[str]) -> list[str]:
    """The same for nodes in a namespace: ``-p <node>:`` means a node without one, and a path is
    not allowed there, only in a file of parameters. That is one in memory, for this process."""
    spaces = {text.partition(":=")[2] for text in arguments if text.startswith("__ns:=")}
    if not spaces:
        return arguments
    (space,) = spaces
    kept: list[str] = []
    given: dict[str, dict[str, dict[str, Any]]] = {}
    words = iter(arguments)
    for word in words:
        value = next(words) if word == "-p" else ""
        found = _OF_NODE.fullmatch(value)
        if found is None:
            kept += [word, value] if value else [word]
            continue
        node = given.setdefault(f"{space}/{found['node']}", {"ros__parameters": {}})
        node["ros__parameters"][found["name"]] = json.loads(found["value"])
    memory = os.memfd_create("parameters", 0)
    os.write(memory, json.dumps(given).encode())
    return [*kept, "--ros-args", "--params-file", f"/proc/self/fd/{memory}", "--"]


def _run(names: list[str], received: list[int]) -> None:
    with serving() as served:
        nodes = {name: _made(served, name) for name in names}
        sim, team = nodes["sim"], nodes.get("team")

        def done() -> object:
            if team is not None and team.failure is not None:
                raise team.failure
            return received or sim.done

        served.until(done)
        if sim.failure is not None:
            raise UserError(sim.failure)
        sim.finish()


def _made(served: Serving, name: str) -> Any:
    if name in _STARTED:
        return served.start(importlib.import_module(_STARTED[name]).start)
    module, node = _NODES[name]
    return served.add(getattr(importlib.import_module(module), node)())


if __name__ == "__main__":
    sys.exit(main())
