"""Who is at a topic's other end, and nodes that do what one alone should do: a second coach, gate,
sim, or policy of a robot."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

UNKNOWN = "_NODE_NAME_UNKNOWN_"  # rmw's word, for a moment after an endpoint's discovery
_PARTICIPANT = 12  # bytes at the beginning of a publisher's gid: two processes differ there


def full_name(info: Any) -> str:
    """Of the node that a publisher or subscription belongs to, with its namespace."""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def publishing_nodes(node: Node, topic: str) -> list[str]:
    """Names with namespaces, in order; two nodes of one name in two processes are there twice.

    A node that was killed (SIGKILL) stays on the graph for up to 20 s.
    """
    found = {
        (full_name(info), bytes(info.endpoint_gid)[:_PARTICIPANT])
        for info in node.get_publishers_info_by_topic(topic)
        if info.node_name != UNKNOWN
    }
    return sorted(name for name, _ in found)


def several(node: Node, topic: str) -> str:
    """Where more than one node publishes on ``topic``: what to say of it; otherwise ''."""
    names = publishing_nodes(node, topic)
    if len(names) < 2:
        return ""
    return f"{len(names)} nodes publish on {node.resolve_topic_name(topic)}: {', '.join(names)}"
