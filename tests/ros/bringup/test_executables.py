"""Every executable is found and runs as `ros2 run` and the launch file would start it."""

from __future__ import annotations

import ast
import json
import re
import signal
import subprocess
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory, get_packages_with_prefixes
from crash_coach_interfaces.msg import CrashPlan, EpisodeState

from crash_coach_bringup.ros.client import graph_client
from crash_coach_bringup.ros.graph import (
    GraphError,
    Node,
    check_team,
    graph_nodes,
    node_process,
)
from crash_coach_bringup.ros.launch_arguments import ARGUMENTS, options_from
from crash_coach_pkg.team import TeamSpec
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

SOURCES = Path(__file__).parents[3] / "ros_ws/src/crash_coach_bringup"
SHARE = Path(get_package_share_directory("crash_coach_bringup"))
LAUNCH_NODES = "crash_coach_bringup.ros.launch_nodes"
DEFAULTS = {a.name: a.default or "" for a in ARGUMENTS}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("team") / "step_0"
    write_untrained(folder, make_env("buttons", 1).spec, seed=1)
    return folder


def launch_nodes(checkpoint: Path, **given: str) -> list[Node]:
    options = options_from({**DEFAULTS, "checkpoint": str(checkpoint), **given})
    return graph_nodes(options, check_team(options))


def start(node: Node, env: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        node_process(node).argv,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=env,
    )


@pytest.mark.parametrize("layout", ["nodes", "team"])
def test_each_executable_runs_appears_in_the_graph_and_ends_on_sigint(
    checkpoint: Path, ros_env: dict[str, str], layout: str
) -> None:
    nodes = launch_nodes(checkpoint, layout=layout)
    expected = {"sim", "coach", "gate"}
    expected |= {"team"} if layout == "team" else {"policy_robot_1", "policy_robot_2"}
    assert {node.name for node in nodes} == expected
    children = {node.name: start(node, ros_env) for node in nodes}
    said = {}
    try:
        with graph_client("looker") as client:
            client.until(
                lambda: expected <= set(client.node.get_node_names()), 20, f"{expected} to appear"
            )
            states: list[EpisodeState] = []
            client.node.create_subscription(EpisodeState, "/sim/episode", states.append, 1)
            client.until(lambda: len(states) > 0, 20, "the first step")
        for child in children.values():
            child.send_signal(signal.SIGINT)
        for name, child in children.items():
            said[name], _ = child.communicate(timeout=30)
    finally:  # one that hangs must not leave the others on a domain that the next test gets
        for child in children.values():
            child.kill()
            child.wait(timeout=10)
    assert {name: child.returncode for name, child in children.items()} == dict.fromkeys(
        expected, 0
    )
    for name, text in said.items():
        (line,) = text.splitlines()
        assert re.fullmatch(r"\[INFO\] \[[\d.]+\] \[" + name + r"\]: ready: [^<>]+", line), text


@pytest.mark.skipif("rviz2" in get_packages_with_prefixes(), reason="RViz is installed here")
def test_rviz_that_is_not_installed_is_refused_before_anything_starts(checkpoint: Path) -> None:
    with pytest.raises(GraphError, match="rviz:=true, but package rviz2 is not installed"):
        launch_nodes(checkpoint, rviz="true")


@pytest.mark.parametrize("file", ["team", "own_robots"])
def test_a_launch_file_uses_nothing_that_does_not_exist(file: str) -> None:
    path = SHARE / "launch" / f"{file}.launch.py"
    tree = ast.parse(path.read_text())
    compile(tree, str(path), "exec")
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert "generate_launch_description" in defined
    for module, name in imports(tree):
        top = module.partition(".")[0]
        assert top in ("__future__", "launch", "launch_ros", "crash_coach_bringup")
        # What a launch file shares with the other needs launch as well.
        if module == LAUNCH_NODES:
            shared = ast.parse((SOURCES / f"{module.replace('.', '/')}.py").read_text())
            assert name in {n.name for n in shared.body if isinstance(n, ast.FunctionDef)}
        elif top == "crash_coach_bringup":
            assert hasattr(__import__(module, fromlist=[name]), name)


def imports(tree: ast.Module) -> set[tuple[str, str]]:
    return {
        (node.module, alias.name)
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names
    }


def test_every_launch_argument_reaches_the_graph(checkpoint: Path, tmp_path: Path) -> None:
    file = tmp_path / "file.yaml"
    file.write_text("/**:\n  ros__parameters: {lease_s: 2.0}\n")
    given = {
        "scenario": "buttons",
        "checkpoint": str(checkpoint),
        "mode": "lockstep",
        "layout": "team",
        "seed": "7",
        "episodes": "3",
        "crash_rate": "0.25",
        "epsilon": "0.5",
        "relay_observations": "true",
        "namespace": "fleet_a",
        "params_file": str(file),
        "use_sim_time": "true",
        "log_level": "warn",
        "fault_scenario": "one_mute",
        "rviz": "false",
    }
    assert set(given) == {argument.name for argument in ARGUMENTS}
    options = options_from(given)
    nodes = {node.name: node for node in graph_nodes(options, TeamSpec(("robot_1",)))}
    parameters = {name: node.parameters for name, node in nodes.items()}
    assert parameters["sim"]["seed"] == parameters["coach"]["seed"] == 7
    assert parameters["sim"]["episodes"] == 3
    assert parameters["gate"]["lockstep"] is True
    assert parameters["gate"]["relay_observations"] is True
    assert parameters["team"]["epsilon"] == 0.5
    assert str(parameters["coach"]["fault_scenario"]).endswith("one_mute.yaml")
    assert {n for n, p in parameters.items() if p.get("use_sim_time")} == {"gate", "coach", "team"}
    for node in nodes.values():
        assert (node.namespace, node.log_level, node.params_file) == ("/fleet_a", "warn", file)
        words = node.arguments()
        assert words.index("--params-file") > max(i for i, w in enumerate(words) if w == "-p")
        assert words[words.index("--log-level") + 1] == "warn"
    rated = options_from({**given, "fault_scenario": ""})
    coach = {node.name: node for node in graph_nodes(rated, TeamSpec(("robot_1",)))}["coach"]
    assert coach.parameters["crash_rate"] == 0.25


@pytest.mark.parametrize("text", ["-0.1", "1.5", "nan", "much"])
@pytest.mark.parametrize("name", ["crash_rate", "epsilon"])
def test_a_launch_argument_that_is_no_probability_is_named(
    checkpoint: Path, name: str, text: str
) -> None:
    with pytest.raises(GraphError, match=f"{name}:={text} is not a number from 0 to 1"):
        launch_nodes(checkpoint, **{name: text})


@pytest.mark.parametrize("name", ["seed", "episodes"])
def test_a_launch_argument_that_is_no_number_is_named(checkpoint: Path, name: str) -> None:
    with pytest.raises(GraphError, match=f"{name}:=-1"):
        launch_nodes(checkpoint, **{name: "-1"})


def test_an_executable_that_is_not_installed_is_named() -> None:
    with pytest.raises(GraphError, match="no executable 'fly'"):
        node_process(Node("x", "sim_pkg", "fly", {}))
    with pytest.raises(GraphError, match="no_pkg is not on AMENT_PREFIX_PATH"):
        node_process(Node("x", "no_pkg", "fly", {}))


def test_the_rviz_layout_shows_topics_that_the_graph_has() -> None:
    layout = yaml.safe_load((SHARE / "rviz" / "team.rviz").read_text())["Visualization Manager"]
    assert layout["Global Options"]["Fixed Frame"] == "map"
    topics = {d["Topic"]["Value"] for d in layout["Displays"] if "Topic" in d}
    assert topics == {"/sim/markers", "/robot_1/odom", "/robot_2/odom"}


def test_the_foxglove_layout_shows_topics_that_the_graph_has() -> None:
    layout = json.loads((SOURCES / "foxglove" / "team.json").read_text())
    panels = layout["configById"]
    assert set(re.findall(r'"([^"]+![a-z]+)"', json.dumps(layout["layout"]))) == set(panels)
    assert list(panels["3D!team"]["topics"]) == ["/sim/markers"]
    assert panels["3D!team"]["followTf"] == "map"
    assert panels["DiagnosticSummary!team"]["topicToRender"] == "/diagnostics"
    paths = [path["value"] for path in panels["Plot!return"]["paths"]]
    fields = {"/sim/episode": EpisodeState, "/coach/plan": CrashPlan}
    for topic, _, field in (path.partition(".") for path in paths):
        assert field in fields[topic].get_fields_and_field_types()
