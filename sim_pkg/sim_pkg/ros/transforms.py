"""map -> <robot>/odom -> <robot>/base_link for tf2: where its messages are installed.

Every Jazzy distribution has tf2_msgs, the wheels have not: there the sim publishes none.
"""

from __future__ import annotations

from collections.abc import Sequence

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Header

from crash_coach_common.ros.qos import latched
from sim_pkg.session import Session

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

BASE_LINK = "base_link"
# As tf2_ros' listeners and broadcasters have it.
_DYNAMIC = QoSProfile(depth=100)
_STATIC = latched()


class Transforms:
    """A robot's odometry is perfect: its odom frame is the map's, once and for all. Where it is in
    that is published after every step, while somebody listens."""

    def __init__(self, node: Node, robots: Sequence[str], map_frame: str) -> None:
        self._listened = False
        self._pub = None
        if TFMessage is None:
            return
        self._frames = [f"{robot}/odom" for robot in robots]
        self._children = [f"{robot}/{BASE_LINK}" for robot in robots]
        self._pub = node.create_publisher(TFMessage, "tf", _DYNAMIC)
        self._static_pub = node.create_publisher(TFMessage, "tf_static", _STATIC)
        still = Header(frame_id=map_frame)
        self._static_pub.publish(
            TFMessage(transforms=[_transform(still, frame) for frame in self._frames])
        )

    def refresh_listeners(self) -> None:
        self._listened = self._pub is not None and self._pub.get_subscription_count() > 0

    def look(self, session: Session, header: Header) -> None:
        """After every step, with the header of its observations."""
        if not self._listened or self._pub is None:
            return
        transforms = []
        places = zip(self._frames, self._children, session.env.positions_m[0].tolist(), strict=True)
        for frame, child, (x, y) in places:
            moved = _transform(Header(stamp=header.stamp, frame_id=frame), child)
            moved.transform.translation.x, moved.transform.translation.y = x, y
            transforms.append(moved)
        self._pub.publish(TFMessage(transforms=transforms))


def _transform(header: Header, child: str) -> TransformStamped:
    """Of no distance and no turn: robots keep the map's axes, as their odometry does."""
    transform = TransformStamped(header=header, child_frame_id=child)
    transform.transform.rotation.w = 1.0
    return transform
