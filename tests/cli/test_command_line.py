"""The command line's own logic: options, errors as one line, results as JSON."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest
from in_process import refused, typed

from crash_coach_bringup.cli.main import repeat_options
from crash_coach_bringup.cli.options import conditions, mode_parameters, timed
from crash_coach_bringup.cli.output import CliError, check_json_target, write_json
from crash_coach_bringup.cli.verbs import doctor
from crash_coach_bringup.cli.verbs.train import plan_jobs
from crash_coach_bringup.ros.probe import find_executable
from crash_coach_bringup.ros.shared_memory import half_made
from policy_pkg import native
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

ROBOTS = ("robot_1", "robot_2")


def crash_coach(
    *arguments: str, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs the installed command."""
    command = [str(find_executable("crash_coach_bringup", "crash-coach")), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=250, env=env)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "step_000000000"
    write_untrained(path, make_env("buttons", 1).spec, seed=1)
    return path


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (
            "evaluate run --crashed 0 1 2 --mode stay --json x",
            "evaluate run --crashed 0 --crashed 1 --crashed 2 --mode stay --json x",
        ),
        ("train a --seed 1 -2", "train a --seed 1 --seed -2"),
        ("evaluate run --victims a b --seed 3", "evaluate run --victims a --victims b --seed 3"),
        ("inject --victims a b", "inject --victims a --victims b"),
        # An option with one value here, with several elsewhere.
        ("evaluate --seed 1 run", "evaluate --seed 1 run"),
        ("render --crash-rate 0.1 run --out x", "render --crash-rate 0.1 run --out x"),
        ("faults run --seed 1 mute", "faults run --seed 1 mute"),
        # What is no value of the option any more is the argument.
        ("evaluate --crashed 0 1 run", "evaluate --crashed 0 --crashed 1 run"),
        ("train --set a=1 b.c=2 x y", "train --set a=1 --set b.c=2 x y"),
        ("train-offline cfg --seed 1 2 bag", "train-offline cfg --seed 1 --seed 2 bag"),
        ("calibrate maps --policy a b", "calibrate maps --policy a --policy b"),
        ("evaluate --victims=a run", "evaluate --victims=a run"),
        ("evaluate --crashed x --help", "evaluate --crashed x --help"),
        ("evalute --crashed 0 1", "evalute --crashed 0 1"),
        ("", ""),
    ],
)
def test_options_take_several_values(given: str, expected: str) -> None:
    assert repeat_options(given.split()) == expected.split()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("evaluate --victims robot_1 run", "no TEAM: --victims takes everything up to the next"),
        ("render --victims robot_1 run --out x", "give TEAM first"),
        ("calibrate --policy kite skirmish/3m --episodes 4", "no SCENARIO: --policy takes every"),
    ],
)
def test_an_argument_that_an_option_took_is_named(given: str, message: str) -> None:
    with pytest.raises(CliError, match=message):
        repeat_options(given.split())


def test_conditions_in_order() -> None:
    found = conditions(ROBOTS, [0.05], [0, 1], ["robot_2"], "delay", {"steps": 2.0})
    assert [c.crash.crash_rate for c in found] == [0.05, 0.0, 0.0, 0.0]
    assert [c.crash.crashed_exactly for c in found] == [-1, 0, 1, -1]
    assert found[3].crash.victims == ("robot_2",)
    assert {c.crash.crash_mode for c in found} == {"delay"}
    assert [c.crash.crash_parameters for c in found] == [{"steps": 2.0}] * 4


def test_without_a_crash_option_it_is_crash_free() -> None:
    (found,) = conditions(ROBOTS, [], [], [], "mute", {})
    assert found.crash.strategy == "none"


@pytest.mark.parametrize(
    ("rates", "crashed", "victims", "names"),
    [
        ([float("nan")], [], [], "--crash-rate nan"),
        ([1.5], [], [], "--crash-rate 1.5"),
        ([], [3], [], "--crashed 3"),
        ([], [-1], [], "--crashed -1"),
        ([], [], ["robot_9"], "robot_9"),
        ([], [], ["robot_1", "robot_1"], "--victims: robot_1 is given twice"),
        ([0.1, 0.1], [], [], "--crash-rate: 0.1 is given twice"),
        ([], [1, 0, 1], [], "--crashed: 1 is given twice"),
        ([], [], [], "--mode random: nobody crashes; say who, such as --crashed 1"),
    ],
)
def test_wrong_conditions_are_named(
    rates: list[float], crashed: list[int], victims: list[str], names: str
) -> None:
    with pytest.raises(CliError, match=names):
        conditions(ROBOTS, rates, crashed, victims, "random", {})


@pytest.mark.parametrize(
    ("mode", "given", "message"),
    [
        ("explode", [], "--mode explode: unknown crash mode .*mute, random"),
        ("delay", ["steps"], "--param steps: NAME=VALUE"),
        ("delay", ["=3"], "--param =3: NAME=VALUE"),
        ("delay", ["steps=much"], "--param steps=much: 'much' is not a number"),
        ("delay", ["steps=2", "steps=3"], "--param steps=3: steps is given more than once"),
        ("delay", ["stps=3"], "--param: .*stps.*its parameters: steps"),
        ("delay", ["steps=0"], "--param: .*steps = 0.0: .*greater than or equal to 1"),
        ("delay", ["steps=2.5"], "--param: .*steps = 2.5: .*integer"),
        ("noise", ["stddev=nan"], "--param: .*stddev = nan: .*finite"),
        ("mute", ["steps=3"], "--param: .*its parameters: none"),
    ],
)
def test_wrong_modes_and_parameters_are_named(mode: str, given: list[str], message: str) -> None:
    with pytest.raises(CliError, match=message):
        mode_parameters(mode, given)


def test_faults_in_some_steps_alone() -> None:
    asked = conditions(("robot_1", "robot_2"), [0.5], [0, 1], ["robot_2"], "delay", {"steps": 3})
    late = timed(asked, 5, 0)
    assert [c.name for c in late] == [
        "rate 0.5, from step 5 on",
        "0 crashed",
        "1 crashed, from step 5 on",
        "robot_2 delay, from step 5 on",
    ]
    assert late[1] == asked[1]
    short = timed(asked, 5, 2)[3].crash
    assert (short.start_step, short.duration_steps, short.crash_parameters) == (5, 2, {"steps": 3})
    assert timed(asked, 5, 2)[3].name == "robot_2 delay, steps 5 to 6"
    assert timed(asked, 0, 0) == asked
    for start, duration, option in ((5, 0, "--start 5"), (0, 2, "--duration-steps 2")):
        with pytest.raises(CliError, match=f"{option}: nobody crashes"):
            timed(conditions(("robot_1",), [], [], [], "mute", {}), start, duration)


def test_parameters_of_a_mode() -> None:
    assert mode_parameters("drop", ["to_bad=.1", "probability=1"]) == {
        "to_bad": 0.1,
        "probability": 1.0,
    }
    assert mode_parameters("stay", []) == {}


def test_several_runs_get_folders_of_their_own(tmp_path: Path) -> None:
    jobs = plan_jobs(["buttons/qmix", "buttons/adaptive"], tmp_path, [], [1, 2], False)
    folders = [job.out_dir.relative_to(tmp_path).name for job in jobs]
    assert folders == ["qmix-s1", "adaptive-s1", "qmix-s2", "adaptive-s2"]
    (one,) = plan_jobs(["buttons/qmix"], tmp_path, ["total_steps=5"], [7], False)
    assert (one.out_dir, one.config.seed, one.config.total_steps) == (tmp_path, 7, 5)


def test_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CliError, match="qmix-s1"):
        plan_jobs(["buttons/qmix"], tmp_path, [], [1, 1], False)


def test_json_is_whole_or_absent(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    write_json(target, {"a": 1})
    assert json.loads(target.read_text()) == {"a": 1}
    assert list(tmp_path.iterdir()) == [target]
    with pytest.raises(CliError, match="is not a folder"):
        check_json_target(target / "result.json")


def test_evaluate_writes_what_it_prints(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    done = crash_coach(
        *("evaluate", str(checkpoint), "--scenario", "buttons", "--episodes", "4"),
        *("--crashed", "0", "1", "--json", str(out)),
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    assert [c["crash"]["crashed_exactly"] for c in result["conditions"]] == [0, 1]
    assert [len(c["per_episode"]) for c in result["conditions"]] == [4, 4]
    assert [len(e["crashed"]) for e in result["conditions"][1]["per_episode"]] == [1] * 4
    assert result["trajectory_hash"] in done.stdout


def test_the_open_loop_control(tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    done = typed("calibrate", "buttons", "--open-loop", "--episodes", "4", "--json", str(out))
    assert done.returncode == 0, done.stderr
    rows = json.loads(out.read_text())["rows"]
    assert [row["policy"] for row in rows] == ["open loop, what it can do", "open loop"]
    # Nothing is drawn on buttons: a list of actions is all that it takes.
    assert [row["success_rate"] for row in rows] == [1.0, 1.0]
    assert "--open-loop searches" in refused(
        "calibrate", "buttons", "--open-loop", "--crashed", "1"
    )


def test_evaluate_tells_what_each_robot_costs(tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    team = ("evaluate", "scripted:coverage_adaptive", "--scenario", "coverage")
    done = typed(*team, "--episodes", "8", "--each-robot", "--json", str(out))
    assert done.returncode == 0, done.stderr
    free, *alone = json.loads(out.read_text())["conditions"]
    robots = [f"robot_{i + 1}" for i in range(len(alone))]
    assert [c["name"] for c in alone] == [f"{robot} mute" for robot in robots]
    assert "cost" not in free
    for condition in alone:
        assert condition["cost"] == free["success_rate"] - condition["success_rate"]
        low, high = condition["cost_ci95"]
        assert low <= condition["cost"] <= high
    # Those first that cost most; robots that cost the same in their order.
    costs = {condition["name"]: -condition["cost"] for condition in alone}
    shown = [line.split("│")[1].strip() for line in done.stdout.splitlines() if " mute " in line]
    assert shown == sorted(costs, key=costs.__getitem__)
    # A single condition is held against the crash-free one as well.
    typed(*team, "--episodes", "4", "--victims", "robot_1", "--json", str(out))
    assert [c["name"] for c in json.loads(out.read_text())["conditions"]] == [
        "crash-free", "robot_1 mute",
    ]  # fmt: skip


def test_bad_input_names_the_thing(checkpoint: Path, tmp_path: Path) -> None:
    run = str(checkpoint)
    assert "robot_9" in refused("evaluate", run, "--victims", "robot_9")
    assert "nan" in refused("evaluate", run, "--crash-rate", "nan")
    assert "buttonz" in refused("evaluate", run, "--scenario", "buttonz")
    assert "nowhere" in refused("evaluate", str(tmp_path / "nowhere"))
    assert "robots" in refused("evaluate", run, "--scenario", "buttons_8")


def test_misspelt_key_writes_nothing(tmp_path: Path) -> None:
    text = refused("train", "buttons/qmix", "--out", str(tmp_path / "run"), "--set", "gama=0.9")
    assert "gama" in text
    assert not (tmp_path / "run").exists()


def test_inject_needs_exactly_one_intention() -> None:
    assert "--victims" in refused("inject")
    assert "--clear" in refused("inject", "--clear", "--victims", "robot_1")


def test_a_pace_is_for_lock_step() -> None:
    fast = ("--mode", "realtime", "--pace-hz", "5")
    assert "--pace-hz 5: real time" in refused("up", "buttons", "--policy", "scripted:hold", *fast)


def test_inject_without_a_coach_says_so(ros_env: dict[str, str]) -> None:
    done = crash_coach("inject", "--victims", "robot_1", "--timeout-s", "1", env=ros_env)
    assert done.returncode == 1
    assert "coach" in done.stderr
    assert ros_env["ROS_DOMAIN_ID"] in done.stderr


def test_doctor_finds_this_machine_fit(ros_env: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "doctor.json"
    done = crash_coach("doctor", "--json", str(out), env=ros_env)
    findings = {row["check"]: row for row in json.loads(out.read_text())["findings"]}
    assert done.returncode == 0, done.stdout
    assert {"Python", "torch", "messages", "executables", "DDS on this machine"} <= set(findings)
    assert findings["shared memory"]["ok"]


def test_doctor_names_a_segment_that_a_killed_node_left_half_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "SHARED_MEMORY", tmp_path)
    contents = {
        "fastrtps_port7011": bytes(8),
        "fastrtps_port7012": b"\2" + bytes(7),
        "fastrtps_port7011_el": b"",  # a lock
        "fastrtps_0123456789abcdef": b"",
        "sem.fastrtps_port7011_mutex": bytes(8),
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    assert half_made(tmp_path) == []  # they may be about to be made
    for name in contents:
        os.utime(tmp_path / name, (0, 0))
    left = [tmp_path / "fastrtps_0123456789abcdef", tmp_path / "fastrtps_port7011"]
    assert half_made(tmp_path) == left
    finding = doctor.shared_memory()
    assert not finding.ok
    assert f"rm {left[0]} {left[1]}" in finding.hint


def test_doctor_says_what_acts_and_learns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for asked, ok, found in (
        ("", True, native.build_name()),
        (native.TORCH, True, "none, as CRASH_COACH_KERNEL asks"),
        ("fast", False, "none"),
    ):
        monkeypatch.setenv(native.VARIABLE, asked)
        finding = doctor.compiled_kernels()
        assert (finding.ok, finding.found) == (ok, found)
    assert "CRASH_COACH_KERNEL=fast" in finding.hint
    monkeypatch.setenv(native.VARIABLE, "")
    monkeypatch.setattr(native, "FOLDER", tmp_path)
    finding = doctor.compiled_kernels()
    assert (finding.ok, finding.found) == (False, "none")
    assert "make setup" in finding.hint


def test_doctor_names_what_is_missing(tmp_path: Path) -> None:
    broken = {**os.environ, "AMENT_PREFIX_PATH": str(tmp_path)}
    done = crash_coach("doctor", env=broken)
    assert done.returncode == 1
    assert "PROBLEM" in done.stdout
    assert "make setup" in done.stdout
