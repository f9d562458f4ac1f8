"""What ROS of this shell can do: the facts behind `crash-coach doctor`."""

from __future__ import annotations

import os
import time
from pathlib import Path

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from crash_coach_bringup.ros.domain import reserve_domain

EXECUTABLES = {
    "sim_pkg": ("sim",),
    "policy_pkg": ("policy", "team"),
    "crash_coach_pkg": ("coach", "gate"),
    "crash_coach_bringup": ("crash-coach",),
}


def find_executable(package: str, name: str) -> Path:
    """The file that `ros2 run package name` would start.

    Raises:
        FileNotFoundError: the package is not on AMENT_PREFIX_PATH, or lacks the executable.
    """
    try:
        prefix = get_package_prefix(package)
    except PackageNotFoundError:
        raise FileNotFoundError(
            f"package {package} is not on AMENT_PREFIX_PATH: run 'make setup', then '. ./env.sh'"
        ) from None
    path = Path(prefix) / "lib" / package / name
    if not os.access(path, os.X_OK):
        raise FileNotFoundError(f"package {package} has no executable {name!r}: {path}")
    return path


def round_trip_ms(timeout_s: float = 10.0) -> float:
    """Sends a message to a second participant and back over DDS, in a domain of its own.

    Returns:
        Milliseconds from the first sending to the receipt.

    Raises:
        TimeoutError: nothing arrived in ``timeout_s``.
    """
    with reserve_domain() as domain:
        contexts = [Context(), Context()]
        for context in contexts:
            rclpy.init(args=[], context=context, domain_id=domain)
        try:
            return _ping(contexts, timeout_s)
        finally:
            for context in contexts:
                context.try_shutdown()


def _ping(contexts: list[Context], timeout_s: float) -> float:
    here, there = (Node(f"doctor_{i}", context=c) for i, c in enumerate(contexts))
    executors = [SingleThreadedExecutor(context=c) for c in contexts]
    for executor, node in zip(executors, (here, there), strict=True):
        executor.add_node(node)
    answers: list[float] = []
    back = there.create_publisher(String, "pong", 1)
    there.create_subscription(String, "ping", back.publish, 1)
    here.create_subscription(String, "pong", lambda _: answers.append(time.monotonic()), 1)
    ping = here.create_publisher(String, "ping", 1)
    deadline = time.monotonic() + timeout_s
    while ping.get_subscription_count() == 0 or back.get_subscription_count() == 0:
        if time.monotonic() > deadline:
            raise TimeoutError(f"no DDS discovery on this machine within {timeout_s:.0f} s")
        time.sleep(0.01)
    start = time.monotonic()
    ping.publish(String(data="ping"))
    while not answers:
        for executor in executors:
            executor.spin_once(timeout_sec=0.001)
        if time.monotonic() > deadline:
            raise TimeoutError(f"no DDS message on this machine within {timeout_s:.0f} s")
    return 1000 * (answers[0] - start)
