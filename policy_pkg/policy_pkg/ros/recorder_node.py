"""Executable ``recorder``: a team's topics to a rosbag2 recording."""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from crash_coach_interfaces.msg import Action, CrashPlan, EpisodeState, FaultEvent, Observation
from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from crash_coach_common.contract import UserError
from policy_pkg.bags.about import About
from policy_pkg.bags.recorder import Recorder
from policy_pkg.bags.topics import INTERFACES, Connection, connections, load_typestore
from policy_pkg.bags.writer import BagWriter, Split
from policy_pkg.ros.recorder_params import RecorderParameters, read_parameters

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
PROFILE = Path(__file__).with_name("recorder_fastdds.xml")
SPIN_S = 0.1  # how soon a signal is noticed
_DEPTH = 2000  # of each topic: what may wait for this process while it is not scheduled
_LINGER_S = 0.5  # for what is still on its way when the last episode's end is here
_LOOK_S = 1.0  # how often drops are told
_CLASSES = {
    message.__name__: message
    for message in (
        Action, Clock, CrashPlan, EpisodeState, FaultEvent, Observation, Odometry,
    )
}  # fmt: skip
RCLError: type[Exception] = rclpy_implementation.RCLError  # bad --ros-args, for one


class RecorderNode(Node):
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
                connection.topic,
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
    durability = DurabilityPolicy.TRANSIENT_LOCAL if connection.latched else None
    if durability is None:
        return QoSProfile(depth=_DEPTH)
    return QoSProfile(depth=_DEPTH, durability=durability)


def _list(drops: dict[str, int]) -> str:
    return ", ".join(f"{topic} {count}" for topic, count in drops.items())


def _record(received: list[int]) -> str:
    """Records until a signal comes or it is done; returns a line about the recording."""
    executor, node = EventsExecutor(), None
    try:
        node = RecorderNode()
        executor.add_node(node)
        gc.freeze()  # what was loaded so far stays: no collection need look at it again
        node.get_logger().info("recording")
        while not received and not node.done:
            executor.spin_once(timeout_sec=SPIN_S)
        end_s = time.monotonic() + _LINGER_S
        while not received and (left_s := end_s - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left_s)
    finally:
        # In this order: DDS must not call back into what is gone (the executor first lets go).
        executor.shutdown()
        summary = node.finish() if node is not None else ""
        if node is not None:
            node.destroy_node()
    return summary


def main() -> int:
    """Exit code 0 at the end or on SIGINT or SIGTERM; 1 after one line of error."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    # Read when the first node is made. Whoever set it knows better.
    os.environ.setdefault(PROFILE_VARIABLE, str(PROFILE))
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        print(f"recorder: {_record(received)}", flush=True)  # noqa: T201
    except (UserError, ParameterException, RCLError) as error:
        print(f"recorder: error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
