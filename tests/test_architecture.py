"""The import law, the links, the limits on size: what docs/architecture.md promises."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
BRINGUP = ROOT / "ros_ws/src/crash_coach_bringup/crash_coach_bringup"
COMMON = ROOT / "ros_ws/src/crash_coach_common/crash_coach_common"
PACKAGES = {
    "crash_coach_common": COMMON,
    "sim_pkg": ROOT / "sim_pkg/sim_pkg",
    "policy_pkg": ROOT / "policy_pkg/policy_pkg",
    "crash_coach_pkg": ROOT / "crash_coach_pkg/crash_coach_pkg",
    "crash_coach_bringup": BRINGUP,
    "crash_coach_console": ROOT / "ros_ws/src/crash_coach_console/crash_coach_console",
}
# The rooms of policy_pkg that put simulator, coach and policies together.
JOINING = {"bags", "play", "report", "sweep", "train"}
MESSAGES = {
    "rclpy", "crash_coach_interfaces", "std_msgs", "geometry_msgs", "nav_msgs", "std_srvs",
    "visualization_msgs", "diagnostic_msgs", "rosgraph_msgs", "rcl_interfaces", "tf2_msgs",
    "builtin_interfaces", "ament_index_python",
}  # fmt: skip
TORCHSCRIPT = ("export", "torchscript.py")
WARN_FILE_LINES, MAX_FILE_LINES = 300, 500
MAX_FUNCTION_LINES = 50


def modules() -> Iterator[tuple[str, Path]]:
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            yield package, path


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Every imported module, also inside functions, with its line."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            yield str(node.module), node.lineno
            for alias in node.names:
                yield f"{node.module}.{alias.name}", node.lineno


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


def allowed(package: str, path: Path, name: str) -> bool:
    """Whether the import law lets ``path`` import ``name``."""
    inside = path.relative_to(PACKAGES[package]).parts
    top = name.split(".")[0]
    if top in MESSAGES:
        return "ros" in inside[:-1]
    if top == "pymunk":
        return path == PACKAGES["sim_pkg"] / "chipmunk.py"
    if top == "torch":
        return package == "policy_pkg" and (inside[0] == "learner" or inside == TORCHSCRIPT)
    if top == "yaml":
        return path == COMMON / "strict_yaml.py"
    if top not in PACKAGES or top == package or package == "crash_coach_bringup":
        return True
    if top == "crash_coach_common":
        return "ros" in inside[:-1] or not within(name, f"{top}.ros")
    if within(name, f"{top}.ros"):
        return False
    if package == "crash_coach_console":  # shows all three; the command line starts it
        return top != "crash_coach_bringup"
    return package == "policy_pkg" and inside[0] in JOINING and top != "crash_coach_bringup"


def test_verbs_do_not_import_verbs() -> None:
    """What several need has a module of its own: options, playing, figure_style, output."""
    cli = BRINGUP / "cli"
    broken = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in sorted(cli.rglob("*.py"))
        if path != cli / "main.py"
        for name, line in imports(path)
        if within(name, "crash_coach_bringup.cli.verbs")
    ]
    assert not broken, "\n".join(broken)


def test_import_law() -> None:
    broken = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for package, path in modules()
        for name, line in imports(path)
        if not allowed(package, path, name)
    ]
    assert not broken, "\n".join(broken)


@pytest.mark.parametrize(
    ("package", "inside", "name", "expected"),
    [
        ("sim_pkg", "env.py", "policy_pkg.act", False),
        ("sim_pkg", "env.py", "crash_coach_pkg.plan", False),
        ("sim_pkg", "env.py", "crash_coach_common.contract", True),
        ("sim_pkg", "env.py", "crash_coach_common.ros.run_node", False),
        ("sim_pkg", "env.py", "pymunk", False),
        ("sim_pkg", "chipmunk.py", "pymunk", True),
        ("sim_pkg", "env.py", "rclpy", False),
        ("sim_pkg", "ros/sim_node.py", "rclpy.node", True),
        ("sim_pkg", "ros/sim_node.py", "crash_coach_common.ros.run_node", True),
        ("crash_coach_common", "contract.py", "sim_pkg.env", False),
        ("crash_coach_common", "strict_yaml.py", "yaml", True),
        ("crash_coach_pkg", "gate/action_gate.py", "crash_coach_common.contract", True),
        ("crash_coach_pkg", "gate/action_gate.py", "sim_pkg.env", False),
        ("crash_coach_pkg", "coach/fault_scenario.py", "crash_coach_common.strict_yaml", True),
        ("policy_pkg", "policy.py", "torch", False),
        ("policy_pkg", "learner/learner.py", "torch.nn", True),
        ("policy_pkg", "learner/learner.py", "crash_coach_pkg.plan", False),
        ("policy_pkg", "export/torchscript.py", "torch", True),
        ("policy_pkg", "export/export.py", "torch", False),
        ("policy_pkg", "play/rollout.py", "torch", False),
        ("policy_pkg", "train/run.py", "torch", False),
        ("policy_pkg", "play/rollout.py", "crash_coach_pkg.coach.coach", True),
        ("policy_pkg", "play/rollout.py", "crash_coach_pkg.ros.gate_node", False),
        ("policy_pkg", "ros/policy_node.py", "crash_coach_pkg.gate.action_gate", False),
        ("policy_pkg", "ros/policy_node.py", "crash_coach_common.ros.parameters", True),
        ("policy_pkg", "ros/node_params.py", "sim_pkg.ros.sim_params", False),
        ("policy_pkg", "agent.py", "crash_coach_common.ros.parameters", False),
        ("policy_pkg", "policy.py", "yaml", False),
        ("crash_coach_console", "team.py", "crash_coach_pkg.plan", True),
        ("crash_coach_console", "team.py", "rclpy", False),
        ("crash_coach_console", "ros/graph_link.py", "rclpy.node", True),
        ("crash_coach_console", "ros/graph_link.py", "crash_coach_pkg.ros.gate_node", False),
        ("crash_coach_console", "command.py", "crash_coach_bringup.ros.client", False),
        ("policy_pkg", "agent.py", "crash_coach_console.team", False),
    ],
)
def test_the_law_itself(package: str, inside: str, name: str, expected: bool) -> None:
    assert allowed(package, PACKAGES[package] / inside, name) is expected


def test_acting_and_evaluating_do_not_load_torch() -> None:
    code = (
        "import sys, policy_pkg.policy, policy_pkg.checkpoint, policy_pkg.play.evaluate, "
        "policy_pkg.play.rollout, policy_pkg.train.config, policy_pkg.train.progress; "
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=250).returncode == 0


def test_files_and_functions_stay_small() -> None:
    folders = [*PACKAGES.values(), ROOT / "tests", ROOT / "benchmarks", ROOT / "scripts"]
    long = []
    for path in (p for folder in folders for p in sorted(folder.rglob("*.py"))):
        text = path.read_text()
        lines = text.count("\n")
        if lines > MAX_FILE_LINES:
            long.append(f"{path.relative_to(ROOT)}: {lines} lines")
        elif lines > WARN_FILE_LINES:
            warnings.warn(f"{path.relative_to(ROOT)}: {lines} lines", stacklevel=1)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or node.lineno) - node.lineno + 1
                if length > MAX_FUNCTION_LINES:
                    long.append(
                        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}: {length} lines"
                    )
    assert not long, "\n".join(long)


def test_links_are_relative_and_lead_somewhere() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-s"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    links = [
        line.split("\t")[1] for line in listed.stdout.splitlines() if line.startswith("120000")
    ]
    assert {"ros_ws/src/sim_pkg", "ros_ws/src/policy_pkg", "ros_ws/src/crash_coach_pkg"} <= set(
        links
    )
    for link in links:
        target = os.readlink(ROOT / link)
        assert not target.startswith("/"), f"{link} -> {target}"
        assert (ROOT / link).exists(), f"{link} -> {target}"


def test_no_path_of_one_machine_is_committed() -> None:
    found = subprocess.run(
        [
            "git",
            "grep",
            "-nIE",
            r"/(root|home/[a-z]+|work)/",
            "--",
            ":!requirements.lock",
            ":!LICENSE",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    hits = [line for line in found.stdout.splitlines() if "test_architecture.py" not in line]
    assert not hits, "\n".join(hits)
