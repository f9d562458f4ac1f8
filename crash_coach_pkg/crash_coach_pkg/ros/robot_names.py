"""The parameter that gates and coach share: whose commands, whose crashes."""

from __future__ import annotations

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import ParameterUninitializedException
from rclpy.node import Node
from rclpy.parameter import Parameter

from crash_coach_common.contract import UserError
from crash_coach_pkg.team import check_robots


def robot_names(node: Node) -> tuple[str, ...]:
    """The parameter ``robots``: the team's namespaces, in order; read-only.

    Raises:
        UserError: it is missing or wrong.
    """
    descriptor = ParameterDescriptor(
        description="Names (namespaces) of the team's robots, in order.", read_only=True
    )
    try:
        names = node.declare_parameter("robots", Parameter.Type.STRING_ARRAY, descriptor).value
    except ParameterUninitializedException:
        names = None
    if names is None:
        name = node.get_name()
        raise UserError(f"parameter 'robots' of {name} is missing: the robots' names, in order")
    return check_robots(names)
