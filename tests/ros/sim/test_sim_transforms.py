"""TF of the sim: with tf2_msgs, which a distribution has and the wheels have not."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from coach_graph import process

BUILD_S, WAIT_S = 500, 60
# As small as what is asked of it: one message of the name and the form that tf2 has.
PACKAGE = """<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name><version>0.0.1</version><description>For a test.</description>
  <maintainer email="team@crash-coach.dev">Crash Coach engineers</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
CMAKE = """cmake_minimum_required(VERSION 3.20)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(geometry_msgs REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} msg/TFMessage.msg DEPENDENCIES geometry_msgs)
ament_package()
"""
READER = """
import json, rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

rclpy.init()
node = rclpy.create_node("reader")
still, moved, odom = [], [], {}
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(TFMessage, "/tf_static", still.append, latched)
node.create_subscription(TFMessage, "/tf", moved.append, 100)

def seen(message):
    p = message.pose.pose.position
    odom[f"{message.header.stamp.sec}.{message.header.stamp.nanosec}"] = [p.x, p.y]

node.create_subscription(Odometry, "/robot_2/odom", seen, 100)
while len(moved) < 8 or len(odom) < 8 or not still:
    rclpy.spin_once(node)

def told(t):
    p, r, s = t.transform.translation, t.transform.rotation, t.header.stamp
    frames = [t.header.frame_id, t.child_frame_id]
    return [f"{s.sec}.{s.nanosec}", *frames, [p.x, p.y], [p.z, r.x, r.y, r.z, r.w]]

print(json.dumps([[told(t) for m in ms for t in m.transforms] for ms in (still, moved)] + [odom]))
"""


def with_tf2(folder: Path, env: dict[str, str]) -> dict[str, str]:
    """The environment in which tf2_msgs is installed: as it is, or with one built in ``folder``."""
    if importlib.util.find_spec("tf2_msgs") is not None:
        return env
    (folder / "src/tf2_msgs/msg").mkdir(parents=True)
    (folder / "src/tf2_msgs/package.xml").write_text(PACKAGE)
    (folder / "src/tf2_msgs/CMakeLists.txt").write_text(CMAKE)
    (folder / "src/tf2_msgs/msg/TFMessage.msg").write_text(
        "geometry_msgs/TransformStamped[] transforms\n"
    )
    prefix = {**env, "CMAKE_PREFIX_PATH": env["VIRTUAL_ENV"]}
    colcon = [
        "colcon",
        "build",
        "--cmake-args",
        "-GNinja",
        f"-DPython3_EXECUTABLE={sys.executable}",
    ]
    built = subprocess.run(
        colcon, cwd=folder, env=prefix, capture_output=True, text=True, timeout=BUILD_S, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr
    install = folder / "install" / "tf2_msgs"
    (site,) = install.glob("lib/python3*/site-packages")
    added = {
        "PYTHONPATH": site,
        "LD_LIBRARY_PATH": install / "lib",
        "AMENT_PREFIX_PATH": install,
    }
    return {**env, **{n: os.pathsep.join((str(p), env.get(n, ""))) for n, p in added.items()}}


@pytest.mark.soak  # without a distribution it builds messages for minutes
def test_frames_and_places(ros_env: dict[str, str], tmp_path: Path) -> None:
    env = with_tf2(tmp_path, ros_env)
    shared = {"scenario": "buttons", "mode": "realtime", "match_timeout_s": 0.5}
    with process(env, "sim", "sim_pkg", real_time_factor=5.0, **shared):
        read = subprocess.run(
            [sys.executable, "-c", READER],
            env=env, capture_output=True, text=True, timeout=WAIT_S, check=False,
        )  # fmt: skip
    assert read.returncode == 0, read.stderr
    still, moved, odom = json.loads(read.stdout)
    unmoved = [[0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]]
    assert [told[1:] for told in still] == [["map", f"robot_{i}/odom", *unmoved] for i in (1, 2)]
    assert {tuple(told[1:3]) for told in moved} == {
        (f"robot_{i}/odom", f"robot_{i}/base_link") for i in (1, 2)
    }
    places = {at: place for at, _, child, place, _ in moved if child == "robot_2/base_link"}
    both = places.keys() & odom.keys()
    assert len(both) > 3
    assert {at: places[at] for at in both} == {at: odom[at] for at in both}
    assert any(place != [0.0, 0.0] for place in places.values())
