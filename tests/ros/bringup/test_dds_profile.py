"""What Fast DDS does otherwise under the profile of graphs that crash-coach starts."""

from __future__ import annotations

from coach_graph import EPISODE, process
from coach_operator import WAIT_S
from crash_coach_interfaces.msg import EpisodeState
from rclpy.duration import Duration

from crash_coach_bringup.ros.client import graph_client


def test_readers_answer_long_before_fast_dds_asks_by_itself(ros_env: dict[str, str]) -> None:
    """Every 3 s; a sim waits for their answers after its last episode."""
    with (
        process(ros_env, "coach", robots=("robot_1",)),
        graph_client("asker", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        boundary = client.node.create_publisher(EpisodeState, "sim/boundary", EPISODE)
        client.until(lambda: boundary.get_subscription_count() == 1, WAIT_S, "the coach")
        boundary.publish(EpisodeState())
        assert boundary.wait_for_all_acked(Duration(seconds=1.5))
