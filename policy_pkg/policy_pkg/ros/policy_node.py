"""Executable ``policy``: one robot's policy in a process of its own."""

from __future__ import annotations

import sys

from policy_pkg.ros.agent_node import AgentNode, spin


class PolicyNode(AgentNode):
    """Parameters: see PolicyParameters."""

    def __init__(self) -> None:
        super().__init__("policy", one_robot=True)


def main() -> int:
    return spin(PolicyNode)


if __name__ == "__main__":
    sys.exit(main())
