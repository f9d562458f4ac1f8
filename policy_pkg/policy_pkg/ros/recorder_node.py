"""Executable ``recorder``: a team's topics to a rosbag2 recording."""

from __future__ import annotations

import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from crash_coach_interfaces.msg import Action, CrashPlan, EpisodeState, FaultEvent, Observation
from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos import DEEP, DEEP_LATCHED
from crash_coach_common.ros.qos_node import QosNode
from crash_coach_common.ros.run_node import run, serving
from policy_pkg.bags.about import About
from policy_pkg.bags.recorder import Recorder
from policy_pkg.bags.topics import INTERFACES, Connection, connections, load_typestore
from policy_pkg.bags.writer import BagWriter, Split
from policy_pkg.ros.recorder_params import RecorderParameters, read_parameters

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
PROFILE = Path(__file__).with_name("recorder_fastdds.xml")
SPIN_S = 0.1  # how soon a signal is noticed
_LINGER_S = 0.5  # for what is still on its way when the last episode's end is here
_LOOK_S = 1.0  # how often drops are told
_CLASSES = {
    message.__name__: message
    for message in (
        Action, Clock, CrashPlan, EpisodeState, FaultEvent, Observation, Odometry,
    )
}  # fmt: skip


class RecorderNode(QosNode):
    """Subscribes to serialized messages and hands them on; see docs/bags.md.

    Raises:
        UserError: a parameter is wrong, or the recording cannot be begun.
    """

    def __init__(self) -> None:
        super().__init__("recorder", start_parameter_services=False)
        self._parameters_read = parameters = read_parameters(self)
        self._connections = connections(
            tuple(parameters.robots),
            parameters.odometry,
            parameters.episode_limit,
        )
        typestore = load_typestore(_interfaces())
        writer = BagWriter(
            Path(parameters.out),
            self._connections,
            typestore,
            _about(parameters),
            time.monotonic,
            Split(parameters.split_bytes, parameters.split_episodes),
            parameters.compression,
        )
        self._recorder = Recorder(writer, self._connections, typestore, parameters.queue_messages)
        for index, connection in enumerate(self._connections):
            self.create_subscription(
                _CLASSES[connection.msgtype.rpartition("/")[2]],
                # Under the node's namespace; the recording has the plain name.
                connection.topic.removeprefix("/"),
                partial(self._recorder.put, index),
                _qos(connection),
                raw=True,
                event_callbacks=SubscriptionEventCallbacks(
                    message_lost=partial(self._on_lost, index)
                ),
            )
        self._told: dict[str, int] = {}
        self.create_timer(_LOOK_S, self._tell_drops)

    @property
    def done(self) -> bool:
        """The wanted number of episodes is recorded, or nothing can be written any more."""
        wanted = self._parameters_read.episodes
        return self._recorder.failure is not None or 0 < wanted <= self._recorder.episodes

    def finish(self) -> str:
        """Ends the recording; returns a line about it.

        Raises:
            UserError: it could not be written to its end.
        """
        try:
            self._recorder.close()
        except OSError as error:
            raise UserError(f"{self._parameters_read.out}: {error.strerror}") from error
        drops = self._recorder.drops
        lost = _list(drops) if drops else "none"
        return (
            f"{self._recorder.messages} messages, {self._recorder.episodes} episodes in "
            f"{self._parameters_read.out}; lost: {lost}"
        )

    def _on_lost(self, connection: int, status: Any) -> None:
        self._recorder.lost(connection, status.total_count_change)

    def _tell_drops(self) -> None:
        drops = self._recorder.drops
        if drops != self._told:
            self._told = drops
            self.get_logger().error(f"messages lost so far: {_list(drops)}")


def _about(parameters: RecorderParameters) -> About:
    return About(
        robots=tuple(parameters.robots),
        scenario=parameters.scenario,
        seed=parameters.seed,
        mode=parameters.mode,
        stay_actions=tuple(action for action in parameters.stay_actions if action >= 0),
        dt_s=parameters.dt_s,
        episode_limit=parameters.episode_limit,
    )


def _interfaces() -> Path:
    try:
        return Path(get_package_share_directory(INTERFACES)) / "msg"
    except PackageNotFoundError:
        raise UserError(f"package {INTERFACES} is not on AMENT_PREFIX_PATH: '. ./env.sh'") from None


def _qos(connection: Connection) -> QoSProfile:
    """Reliable, and deep: a publisher in lock-step does not wait for the recorder."""
    return DEEP_LATCHED if connection.latched else DEEP


def _list(drops: dict[str, int]) -> str:
    return ", ".join(f"{topic} {count}" for topic, count in drops.items())


def _record(received: list[int]) -> None:
    """Records until a signal comes or it is done; says what became of it."""
    with serving() as served:
        node = served.add(RecorderNode())
        try:
            node.get_logger().info("recording")
            served.until(lambda: received or node.done)
            end_s = time.monotonic() + _LINGER_S
            served.until(lambda: received or time.monotonic() >= end_s)
        finally:
            served.executor.shutdown()
            summary = node.finish()
    print(f"recorder: {summary}", flush=True)  # noqa: T201


def main() -> int:
    """Exit code 0 at the end or on SIGINT or SIGTERM; 1 after one line of error."""
    # Read when the first node is made. Whoever set it knows better.
    os.environ.setdefault(PROFILE_VARIABLE, str(PROFILE))
    return run(_record, "recorder")


if __name__ == "__main__":
    sys.exit(main())
