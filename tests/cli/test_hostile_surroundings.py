"""Every verb in every hostile place: a result, or one clear line."""

from __future__ import annotations

import os
import random
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from bag_maker import Made, Team, messages, write
from small_run import SMALL
from sweep_cases import write_sweep

from crash_coach_bringup.cli.main import VERBS
from crash_coach_bringup.ros.domain import reserve_domain
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run import train
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

START = (sys.executable, "-m", "crash_coach_bringup.cli.start")
SEED = int(os.environ.get("HOSTILE_SEED", "0"))
LIMIT_S = 300.0
ENDLESS = frozenset(("gate", "console", "record", "up", "train-live"))
RUN_S = 12.0  # of these
TINY = "total_steps=300 n_envs=2 test_interval_steps=100 test_episodes=2 loggers.tensorboard=false"
COMMANDS = {
    "doctor": "doctor --json OUT.json",
    "train": f"train buttons/qmix --out OUT --seed 1 --set {TINY}",
    "train-live": f"train-live live/buttons --out OUT --layout single --set {TINY}",
    "train-offline": "train-offline offline/behaviour_cloning BAG --out OUT --seed 1 --set "
    "gradient_steps=4 batch_episodes=4 test_interval_steps=2 test_episodes=2 "
    "loggers.tensorboard=false",
    "sweep": "sweep SWEEP --out OUT --processes 2",
    "evaluate": "evaluate TEAM --episodes 4 --each-robot --json OUT.json",
    "profile": "profile buttons/qmix --seconds 2 --json OUT.json",
    "faults": "faults run one_mute --policy TEAM --episodes 4 --out OUT",
    "faults docs": "faults docs",
    "up": "up buttons --policy TEAM --layout single --episodes 2 --logs OUT",
    "inject": "inject --victims robot_1 --timeout-s 1 --json OUT.json",
    "gate": "gate --robots robot_1 robot_2 --logs OUT",
    "console": "console RUN --port 0",
    "record": "record --out OUT --scenario buttons",
    "bags": "bags info BAG",
    "demo": f"demo --episodes 2 --layout single --out OUT --set {TINY}",
    "plot": "plot RUN --out OUT",
    "collect": "collect RUNS OUT",
    "report": "report RUN --episodes 4 --out OUT",
    "behaviour": "behaviour RUN --episodes 4 --json OUT.json",
    "export": "export RUN --out OUT",
    "render": "render TEAM --out OUT.png",
    "calibrate": "calibrate buttons --episodes 4 --json OUT.json",
    "check-scenario": "check-scenario buttons",
}
PLACES = ("narrow", "ascii", "read only", "full disk", "SIGINT", "SIGTERM", "closed pipe")


@dataclass(frozen=True)
class Things:
    """What commands work on, and a domain that nobody else is on."""

    words: dict[str, str]
    env: dict[str, str]

    def command(self, name: str, out: Path) -> list[str]:
        words = {**self.words, "OUT": str(out), "OUT.json": f"{out}.json", "OUT.png": f"{out}.png"}
        return [*START, *(words.get(word, word) for word in COMMANDS[name].split())]


@pytest.fixture(scope="module")
def things(
    tmp_path_factory: pytest.TempPathFactory, team: Team, made: list[Made]
) -> Iterator[Things]:
    folder = tmp_path_factory.mktemp("things")
    config = TrainConfig.model_validate({**SMALL, "total_steps": 600})
    train(config, folder / "runs" / "run")
    policy = folder / "step_000000000"
    write_untrained(policy, make_env("buttons", 1).spec, seed=1)
    bag = write(folder / "bag", team, messages(made))
    sweep = write_sweep(folder / "sweep.yaml", total_steps=600)
    words = {
        "TEAM": str(policy),
        "RUNS": str(folder / "runs"),
        "RUN": str(folder / "runs" / "run"),
        "BAG": str(bag),
        "SWEEP": str(sweep),
    }
    with reserve_domain() as domain:
        yield Things(words, {**os.environ, "ROS_DOMAIN_ID": str(domain)})


def mounted(command: list[str], place: Path, full: bool) -> list[str]:
    """The command where ``place`` is a disk of its own: full, or read-only."""
    at = shlex.quote(str(place))
    make = f"mount -t tmpfs -o size=256k none {at}"
    spoil = f"head -c 250k /dev/zero > {at}/ballast" if full else f"mount -o remount,ro {at}"
    line = f"{make} && {spoil} && exec {shlex.join(command)}"
    return ["unshare", "--mount", "sh", "-c", line]


@pytest.fixture(scope="module")
def can_mount(tmp_path_factory: pytest.TempPathFactory) -> bool:
    place = tmp_path_factory.mktemp("mount")
    done = subprocess.run(mounted(["true"], place, False), capture_output=True, timeout=60)
    return done.returncode == 0


def run(command: list[str], env: dict[str, str], place: str, ends_s: float | None) -> str:
    """Runs it to its end, or to a signal; returns what it said. It must not say too much."""
    number = {"SIGTERM": signal.SIGTERM}.get(place, signal.SIGINT)
    process = subprocess.Popen(
        command, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        if place == "closed pipe":
            process.stdout.close()
            process.stdout = None
        if ends_s is not None:
            try:
                process.wait(timeout=ends_s)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, number)
        out, err = process.communicate(timeout=LIMIT_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate(timeout=30)
    said = (out or b"") + err
    assert b"Traceback" not in said, said.decode(errors="replace")
    text = said.decode(errors="replace")
    told = [line for line in err.decode(errors="replace").splitlines() if line[:6] != "[INFO]"]
    code = process.returncode
    if code in (0, -signal.SIGPIPE, 128 + signal.SIGPIPE):
        return text
    # A signal that comes after all is said and done ends Python as any process.
    assert code in (1, 130, 143, -signal.SIGINT, -signal.SIGTERM), (code, text)
    if place == "closed pipe" and not told:  # whoever closes it wants no line either
        return text
    if out and not told:  # what was found is no pass; or it says itself that it was stopped
        stopped = "interrupted" in text or "stopped" in text
        assert code < 0 or code == 1 or stopped, (code, text)
        return text
    clear = [line for line in told if line.startswith(("crash-coach: ", "recorder: "))]
    # A process of the graph was the first that met it.
    clear = clear or [line for line in told if "No space left on device" in line]
    assert len(clear) == 1, (code, text)
    return clear[0]


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_result_or_one_clear_line(
    things: Things, can_mount: bool, tmp_path: Path, name: str, place: str
) -> None:
    chance = random.Random(f"{SEED} {name} {place}")
    out, env, ends_s = tmp_path / "out", dict(things.env), None
    if name in ENDLESS:
        ends_s = RUN_S
    if place == "narrow":
        env["COLUMNS"] = str(chance.randint(20, 60))
    elif place == "ascii":
        env |= {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0"}
    elif place in ("SIGINT", "SIGTERM"):
        ends_s = chance.uniform(0.5, 8.0)
    command = things.command(name, out)
    if place in ("read only", "full disk"):
        if not can_mount:
            pytest.skip("no right to mount a disk of its own (unshare --mount)")
        disk = tmp_path / "disk"
        disk.mkdir()
        command = mounted(things.command(name, disk / "out"), disk, place == "full disk")
    began = time.monotonic()
    said = run(command, env, place, ends_s)
    print(f"{name}, {place}: {time.monotonic() - began:.1f} s: {said.strip()[-200:]}")


def test_every_verb_is_tried() -> None:
    assert {line.split()[0] for line in COMMANDS.values()} == set(VERBS)
