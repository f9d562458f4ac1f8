"""What a distribution's tools read of our packages: package.xml, LICENSE, where the tests are."""

from __future__ import annotations

import configparser
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_architecture import PACKAGES, ROOT, imports

# Python modules by the key that rosdep knows them by (rosdistro, rosdep/python.yaml).
KEYS = {
    "PIL": "python3-pil",
    "gymnasium": "python3-gymnasium-pip",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "onnxruntime": "python3-onnxruntime-pip",
    "pydantic": "python3-pydantic",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "tensorboard": "python3-tensorboard-pip",
    "torch": "python3-torch",
    "typer": "python3-typer",
    "uvicorn": "python3-uvicorn",
    "yaml": "python3-yaml",
}
# rosdep knows none of these: they come from requirements.lock alone, llvmlite also with numba.
WITHOUT_KEY = {
    "imageio_ffmpeg", "llvmlite", "lz4", "mcap", "mlflow", "onnx", "pettingzoo", "pymunk", "ray",
    "safetensors", "sqlalchemy", "starlette", "threadpoolctl", "zstandard",
}  # fmt: skip
ROS = {
    "ament_index_python", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "launch",
    "launch_ros", "nav_msgs", "rcl_interfaces", "rclpy", "rosgraph_msgs", "std_msgs", "std_srvs",
    "tf2_msgs", "visualization_msgs",
}  # fmt: skip
OURS = {*PACKAGES, "crash_coach_interfaces"}
TESTS = {"pytest", "pytest-timeout", "pytest-xdist", "hypothesis"}
# Run, not imported: the messages' transport that our profile is of, and viewers.
RUN = {
    "crash_coach_bringup": {"rmw_fastrtps_cpp", "rviz2"},
    "crash_coach_console": {"python3-websockets"},
}


def folder(package: str) -> Path:
    return ROOT / "ros_ws" / "src" / package


def needed(package: str) -> Iterator[str]:
    """rosdep keys and packages of all that the package imports."""
    places = [*PACKAGES[package].rglob("*.py"), *folder(package).glob("launch/*.py")]
    names = {name.partition(".")[0] for path in places for name, _ in imports(path)}
    for name in names - set(sys.stdlib_module_names) - {package}:
        if name in WITHOUT_KEY:
            continue
        assert name in KEYS or name in ROS | OURS, f"{package} imports {name}: which key is it?"
        yield KEYS.get(name, name)


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_package_xml_declares_all_that_is_imported(package: str) -> None:
    root = ET.parse(folder(package) / "package.xml").getroot()
    declared = [element.text for element in root.findall("exec_depend")]
    assert len(set(declared)) == len(declared)
    assert set(declared) == {*needed(package), *RUN.get(package, ())}
    tested = {element.text for element in root.findall("test_depend")}
    assert tested == {f"python3-{name}" for name in TESTS}


@pytest.mark.parametrize("package", sorted(OURS))
def test_each_package_has_its_licence(package: str) -> None:
    assert (folder(package) / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()
    root = ET.parse(folder(package) / "package.xml").getroot()
    assert [element.text for element in root.findall("license")] == ["Apache-2.0"]


def test_colcon_test_runs_every_room() -> None:
    """A room belongs to one package, and its settings are those of `make test`."""
    rooms: list[Path] = []
    for package in PACKAGES:
        place = folder(package).resolve()
        config = configparser.ConfigParser()
        config.read(place / "setup.cfg")
        section = config["tool:pytest"]
        assert (place / section["pythonpath"]).resolve() == ROOT / "tests" / "support"
        rooms += [(place / path).resolve() for path in section["testpaths"].split()]
    assert len(set(rooms)) == len(rooms)
    assert all(room.exists() for room in rooms)
    covered = {path for room in rooms for path in (room, *room.rglob("test_*.py"))}
    tests = ROOT / "tests"
    left = {str(p.relative_to(tests)) for p in tests.rglob("test_*.py") if p not in covered}
    # Of the checkout, not of a package.
    rooms_of_all = ("documents/", "packages/")
    assert {name for name in left if not name.startswith(rooms_of_all)} == {"test_benchmarks.py"}


def test_colcon_test_finds_tests(tmp_path: Path) -> None:
    """Of the smallest package; where nothing is found, colcon calls it a success all the same."""
    done = subprocess.run(
        [
            "colcon", "--log-base", str(tmp_path / "log"), "test", "--packages-select",
            "crash_coach_common", "--test-result-base", str(tmp_path / "results"),
            "--pytest-args", " -k", "team_cdr",
        ],
        cwd=ROOT / "ros_ws", capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    (report,) = tmp_path.glob("results/**/pytest.xml")
    (suite,) = ET.parse(report).getroot().findall("testsuite")
    assert int(suite.attrib["tests"]) > 0
    assert suite.attrib["failures"] == suite.attrib["errors"] == "0"
