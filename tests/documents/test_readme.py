"""Every command in the README is executed, in a copy of the checkout made of links.

On a machine without a ROS distribution `ros2` is tests/documents/ros2. `make demo` trains for
a few thousand steps only; its full size is what CONTRIBUTING.md asks for before a release.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from crash_coach_bringup.ros.client import graph_client
from crash_coach_bringup.ros.domain import reserve_domain

ROOT = Path(__file__).resolve().parents[2]
SMALL_DEMO = (
    "--layout single --episodes 2 "
    "--set total_steps=2000 test_interval_steps=1000 loggers.tensorboard=false"
)
DISTRIBUTION = Path("/opt/ros/jazzy/setup.bash")


def blocks() -> list[list[str]]:
    """The commands of each bash block of the README, in order."""
    found = re.findall(r"```bash\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    return [text.strip().splitlines() for text in found]


def block(first: str) -> list[str]:
    """The block that begins with ``first``."""
    (found,) = [lines for lines in blocks() if lines[0] == first]
    return found


def session(folder: Path, commands: list[str], env: dict[str, str]) -> subprocess.Popen[str]:
    """A shell in which someone types the commands, stopping at the first that fails."""
    script = "\n".join(["set -eo pipefail", *commands])
    return subprocess.Popen(
        ["bash", "-c", script],
        cwd=folder,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def typed(folder: Path, commands: list[str], env: dict[str, str], code: int = 0) -> str:
    """Types the commands and waits; returns what was printed. They must end with ``code``."""
    shell = session(folder, commands, env)
    try:
        output, _ = shell.communicate(timeout=200)
    finally:
        if shell.poll() is None:
            os.killpg(shell.pid, signal.SIGKILL)
    assert shell.returncode == code, output
    return output


@contextmanager
def running(folder: Path, commands: list[str], env: dict[str, str]) -> Iterator[None]:
    """Keeps the commands running while the body runs, then stops them as Ctrl-C does."""
    shell = session(folder, commands, env)
    try:
        yield
        assert shell.poll() is None, "it ended by itself:\n" + str(shell.communicate()[0])
        os.killpg(shell.pid, signal.SIGINT)
        shell.communicate(timeout=30)
    finally:
        if shell.poll() is None:
            os.killpg(shell.pid, signal.SIGKILL)


def wait_for_steps(env: dict[str, str], count: int = 3) -> None:
    """Returns when the graph on the test's domain has executed ``count`` control steps."""
    from crash_coach_interfaces.msg import EpisodeState

    seen: list[int] = []
    with graph_client("documents", int(env["ROS_DOMAIN_ID"])) as client:
        client.node.create_subscription(
            EpisodeState, "/sim/episode", lambda state: seen.append(state.step), 10
        )
        client.until(lambda: len(seen) >= count, 60, f"{count} control steps")


@pytest.fixture(scope="module")
def env() -> Iterator[dict[str, str]]:
    with reserve_domain() as domain:
        out = {**os.environ, "ROS_DOMAIN_ID": str(domain), "DEMO_OPTIONS": SMALL_DEMO}
        if not DISTRIBUTION.exists():
            out["PATH"] = f"{ROOT / 'tests' / 'documents'}:{out['PATH']}"
        yield out


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Of links, in which nothing was typed but `make setup`."""
    return checkout_of_links(tmp_path / "checkout")


def checkout_of_links(path: Path) -> Path:
    path.mkdir()
    for entry in ROOT.iterdir():
        if entry.name not in ("runs", ".git"):
            (path / entry.name).symlink_to(entry)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, env: dict[str, str]) -> Path:
    """A checkout in which `make demo` was typed."""
    path = checkout_of_links(tmp_path_factory.mktemp("demo") / "checkout")
    # 2,000 steps teach nothing, and the demo has to say so: make's own exit code is then 2.
    output = typed(path, block("make demo")[:1], env, code=2)
    assert "The coached team FAILED: crash-free" in output
    assert "--set total_steps=4000" in output
    return path


def test_the_demo_leaves_what_it_says(folder: Path) -> None:
    demo = folder / "runs" / "demo"
    summary = json.loads((demo / "summary.json").read_text())
    assert set(summary["methods"]) == {"qmix", "adaptive"}
    assert summary["coached_team_copes"] is False
    for method in summary["methods"].values():
        assert len(method["conditions"]) == 3
        assert all(c["episodes"] == 2 for c in method["conditions"])
    assert (demo / "trajectories.png").stat().st_size > 10_000


def test_the_test_command_is_the_gate(folder: Path, env: dict[str, str]) -> None:
    # Executing it here would run this test again without end.
    assert block("make demo")[1] == "make test"
    assert "pytest" in typed(folder, ["make --dry-run test"], env)


def launch() -> list[str]:
    """What starts a graph with a distribution's command line."""
    commands = block(f"source {DISTRIBUTION}")
    return commands if DISTRIBUTION.exists() else commands[1:]


def up_and_inject() -> tuple[list[str], list[str]]:
    up, inject = [lines for lines in blocks() if lines[0] == ". ./env.sh"]
    assert "crash-coach up" in up[1]
    return up, inject


def crash_and_clear(folder: Path, commands: list[str], env: dict[str, str]) -> None:
    """Types commands that crash robot_1 and end that: on the graph it has to be seen."""
    from crash_coach_interfaces.msg import FaultEvent

    events: list[FaultEvent] = []
    with graph_client("documents", int(env["ROS_DOMAIN_ID"])) as client:
        client.node.create_subscription(FaultEvent, "/coach/events", events.append, 1000)
        client.until(
            lambda: client.node.count_publishers("/coach/events") > 0, 60, "the gate's events"
        )
        output = typed(folder, commands, env)
        assert "fail" not in output.lower()
        client.until(
            lambda: any(e.kind == FaultEvent.CLEARED and not e.robot for e in events),
            20,
            "the end of the fault",
        )
    assert {(e.robot, e.mode) for e in events if e.kind == FaultEvent.ACTIVE} == {
        ("robot_1", "mute")
    }
    wait_for_steps(env)


# Each block on a fresh graph: what one sets must not be what lets another work.


def test_up_and_inject(folder: Path, env: dict[str, str]) -> None:
    up, inject = up_and_inject()
    with running(folder, up, env):
        wait_for_steps(env)
        crash_and_clear(folder, inject, env)


@pytest.mark.parametrize("start", ["up", "launch"])
def test_param_set(folder: Path, env: dict[str, str], start: str) -> None:
    with running(folder, up_and_inject()[0] if start == "up" else launch(), env):
        wait_for_steps(env)
        commands = block("ros2 param set /coach enabled true")
        crash_and_clear(folder, [". ./env.sh", *commands], env)


def test_train_and_evaluate(checkout: Path, env: dict[str, str]) -> None:
    output = typed(checkout, [". ./env.sh", *block("crash-coach doctor")], env)
    evaluations = [line for line in block("crash-coach doctor") if " evaluate " in line]
    assert output.count("trajectory hash") == len(evaluations) == 3
    assert (checkout / "runs" / "mine.json").exists()


def test_trained_teams_are_there(checkout: Path, env: dict[str, str]) -> None:
    (teams,) = [lines for lines in blocks() if " results/" in lines[0]]
    output = typed(checkout, [". ./env.sh", *teams], env)
    assert "wrote runs/3m.mp4" in output
    assert "wrote runs/exported/policy.onnx" in output


def node_by_node() -> list[str]:
    """The README's commands: gate, coach, team, sim."""
    commands = [line for lines in blocks() for line in lines if line.startswith("ros2 run")]
    assert len(commands) == 4
    return commands


def together(commands: list[str]) -> list[str]:
    return [". ./env.sh", *(f"{line} &" for line in commands), "wait"]


def test_node_by_node(folder: Path, env: dict[str, str]) -> None:
    with running(folder, together(node_by_node()), env):
        wait_for_steps(env)


def test_live_training_by_hand(folder: Path, env: dict[str, str]) -> None:
    """docs/live.md, for the graph of the README without its trained team."""
    page = (ROOT / "docs" / "live.md").read_text()
    (live,) = re.findall(r"```bash\n(.*?)```", page, flags=re.DOTALL)
    commands = live.replace("/path/of/a/run", "runs/live_by_hand").strip().splitlines()
    assert len(commands) == 2
    gate, coach, _, sim = node_by_node()
    with running(folder, together([gate, coach, sim, *commands]), env):
        wait_for_steps(env)
    assert (folder / "runs" / "live_by_hand").is_dir()


def test_no_block_is_left_out() -> None:
    firsts = [lines[0] for lines in blocks()]
    assert firsts == [
        "make demo",
        ". ./env.sh",
        ". ./env.sh",
        "ros2 param set /coach enabled true",
        "crash-coach doctor",
        "crash-coach evaluate results/recipe/robust/robust-s0 --episodes 4 --each-robot",
        f"source {DISTRIBUTION}",
        'ros2 run crash_coach_pkg gate --ros-args -p robots:="[robot_1, robot_2]"',
    ]


def test_links_between_documents_lead_somewhere() -> None:
    for document in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.name} links to {target}"
