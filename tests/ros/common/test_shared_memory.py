"""The suite clears away what killed nodes leave in shared memory, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from shared_memory import FOLDER, kill_group, mapped_by, remove_left_behind, strike

NODE = """
import sys, rclpy
rclpy.init()
node = rclpy.create_node("left_behind")
print("up", flush=True)
sys.stdin.read()
"""


def make_old(names: set[str]) -> None:
    for name in names:
        os.utime(FOLDER / name, (0, 0))


@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no {FOLDER} here")
def test_a_killed_nodes_segments_go_and_a_living_ones_stay(ros_env: dict[str, str]) -> None:
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", NODE], stdin=pipe, stdout=pipe, env=ros_env) as it:
        try:
            assert it.stdout is not None
            assert it.stdout.readline() == b"up\n"
            mapped = mapped_by(it.pid)
            own = {name for name in mapped if "port" not in name}
            assert own
            make_old(mapped)
            assert not mapped & set(remove_left_behind())
        finally:
            it.kill()
    assert own <= {path.name for path in FOLDER.iterdir()}
    make_old(own)
    assert own <= set(remove_left_behind())
    assert not own & {path.name for path in FOLDER.iterdir()}


@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no {FOLDER} here")
def test_a_group_that_is_killed_leaves_nothing(ros_env: dict[str, str]) -> None:
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", NODE], stdin=pipe, stdout=pipe, env=ros_env, start_new_session=True
    ) as it:
        assert it.stdout is not None
        assert it.stdout.readline() == b"up\n"
        mapped = mapped_by(it.pid)
        kill_group(it)
    assert {name for name in mapped if "port" not in name}
    assert not mapped & {path.name for path in FOLDER.iterdir()}


MAKER = """
import os, sys, time
path = sys.argv[1]
made = os.open(path, os.O_CREAT | os.O_RDWR)
os.truncate(made, 64)
print("up", flush=True)
time.sleep(float(sys.argv[2]))
os.pwrite(made, b"\\2", 0)
time.sleep(60)
"""


@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no {FOLDER} here")
def test_nobody_is_killed_who_makes_a_port() -> None:
    port = FOLDER / "fastrtps_port1"  # of no domain
    command = [sys.executable, "-c", MAKER, str(port), "0.5"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as it:
        assert it.stdout is not None
        assert it.stdout.readline() == b"up\n"
        assert strike(it.pid) == {port.name}
    try:
        assert port.read_bytes()[0] == 2
    finally:
        port.unlink()
