"""Executable ``team``: all robots' policies in one process, one forward pass per step."""

from __future__ import annotations

import sys

from policy_pkg.ros.agent_node import AgentNode, spin


class TeamNode(AgentNode):
    """Parameters: see TeamParameters.

    The checkpoint, or the trainer's weights, name the robots.
    """

    def __init__(self) -> None:
        super().__init__("team", one_robot=False)


def main() -> int:
    return spin(TeamNode)


if __name__ == "__main__":
    sys.exit(main())
