"""What the ROS graph consists of: one command line per process, for every layout."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from crash_coach_bringup.ros import discovery
from crash_coach_bringup.ros.domain import check_domain
from crash_coach_bringup.ros.namespaces import checked_namespace
from crash_coach_bringup.ros.parameter_file import ParameterFile
from crash_coach_bringup.ros.probe import find_executable
from crash_coach_common.contract import UserError
from crash_coach_common.executable import command
from crash_coach_pkg.coach.config import CoachConfig, FaultConfig
from crash_coach_pkg.coach.fault_scenario import load_fault_scenario
from crash_coach_pkg.faults import check_parameters, fault_mode, is_observation_mode
from crash_coach_pkg.team import TeamSpec
from policy_pkg.checkpoint import load_policy
from policy_pkg.team_name import scripted_name
from sim_pkg.env import make_env
from sim_pkg.scripted import make_scripted

Mode = Literal["lockstep", "realtime"]
Layout = Literal["nodes", "team", "single"]
Value = bool | int | float | str | Sequence[str] | Sequence[float] | Sequence[int]

# Where all that counts is what a lock-step graph plays, no fault has to end because a loaded
# machine lets the coach stand still, and everybody with it. The longest lease that a coach takes.
PATIENT_LEASE_S = 60.0
# Layout ``team``: what the gate lets pass reaches the sim without a change of processes.
TOGETHER = ("gate", "sim")
LOST_STEPS = 3  # without a command, as the sim's own default


class GraphError(UserError):
    """The graph cannot be started as asked; the text says what is wrong."""


def nobody_yet() -> CoachConfig:
    """Nobody crashes until victims are named or ``crash_rate`` is set, then as ``at_rate`` does."""
    return CoachConfig(strategy="fixed", resample=False)


@dataclass(frozen=True)
class UpOptions:
    """A graph: which scenario, which policies, how many processes.

    ``layout``: ``nodes`` has a process per node, ``team`` one for all policies and one for gate and
    sim, ``single`` one for everything. ``coach`` holds the coach's settings at start, which
    the file ``fault_scenario`` overrules; ``sim`` further parameters of the sim.
    ``relay_observations``: observations pass through the gate, so that faults of them can be
    injected later; where the coach starts with such faults, they do anyway. ``gate`` false leaves
    coach and gate out: the policies command the robots directly. ``checkpoint`` None: a trainer
    gives the policies their weights, and the coach its success rates. ``epsilon``: with this
    probability, per robot and step, a policy takes a random action, keyed by ``seed``.
    ``namespace``: every name of the graph is in it; empty: none. ``lease_s`` None: the coach's
    default. ``params_file``, ``log_level``: as Node's, of every node; ``use_sim_time``: of every
    node but the sim, whose clock it is.
    """

    scenario: str
    checkpoint: Path | None  # or scripted:NAME
    mode: Mode = "lockstep"
    layout: Layout = "nodes"
    seed: int = 0
    episodes: int = 0  # 0: endless
    autostart: bool = True
    gate: bool = True
    epsilon: float = 0.0
    coach: CoachConfig = field(default_factory=nobody_yet)
    fault_scenario: Path | None = None
    relay_observations: bool = False
    sim: Mapping[str, Value] = field(default_factory=dict)
    domain: int | None = None  # None: ROS_DOMAIN_ID, or 0
    namespace: str = ""
    lease_s: float | None = None
    params_file: Path | None = None
    use_sim_time: bool = False
    log_level: str = "info"
    log_dir: Path = Path("runs/up")


@dataclass(frozen=True)
class Node:
    """A ROS node: where it comes from, its name and namespace ('': none) and its parameters.

    ``params_file``: a ROS parameter file, whose values win.
    """

    name: str
    package: str
    executable: str
    parameters: Mapping[str, Value]
    namespace: str = ""
    params_file: Path | None = None
    log_level: str = "info"

    def arguments(self) -> list[str]:
        """--ros-args for a process that holds this node only."""
        start = ["-r", f"__node:={self.name}", *namespace_rule(self.namespace)]
        return ros_arguments(start, "", self.parameters, self.common())

    def common(self) -> list[str]:
        """What is said once for a process; the file comes last, because later values win."""
        file = ["--params-file", str(self.params_file)] if self.params_file else []
        return ["--log-level", self.log_level, *file]


@dataclass(frozen=True)
class Process:
    """One operating system process. ``name`` names its log file and is what errors say."""

    name: str
    argv: tuple[str, ...]


def domain_id(options: UpOptions) -> int:
    """The domain that the graph runs on. Raises GraphError for one that does not exist."""
    try:
        return check_domain(options.domain)
    except UserError as error:
        raise GraphError(str(error)) from None


def graph_environment(domain: int) -> dict[str, str]:
    """What the processes' environment needs. Raises UserError as discovery.profiles_file."""
    return {"ROS_DOMAIN_ID": str(domain), discovery.VARIABLE: discovery.profiles_file()}


def namespace_rule(namespace: str) -> list[str]:
    return ["-r", f"__ns:={namespace}"] if namespace else []


def ros_arguments(
    start: list[str], prefix: str, parameters: Mapping[str, Value], end: Sequence[str] = ()
) -> list[str]:
    """``start``, one -p per parameter, ``end``. JSON is YAML that keeps its types."""
    arguments = ["--ros-args", *start]
    for name, value in parameters.items():
        plain = value if isinstance(value, bool | int | float | str) else list(value)
        arguments += ["-p", f"{prefix}{name}:={json.dumps(plain)}"]
    return [*arguments, *end, "--"]


def coach_parameters(options: UpOptions, team: TeamSpec) -> dict[str, Value]:
    """The coach node's parameters; settings that are null or default keep the node's default.

    Raises:
        UserError: a parameter that the crash mode does not have.
    """
    config = options.coach
    parameters: dict[str, Value] = {"robots": list(team.robots), "seed": options.seed}
    if options.checkpoint is None:
        parameters["success_from"] = "trainer"
    if team.roles:
        parameters["roles"] = list(team.roles)
    if team.dt_s is not None:
        parameters["dt_s"] = team.dt_s
    if options.lease_s is not None:
        parameters["lease_s"] = options.lease_s
    if options.fault_scenario is not None:
        return {**parameters, "fault_scenario": str(options.fault_scenario.resolve())}
    chosen = config.model_dump(exclude_defaults=True, exclude_none=True)
    chosen.pop(config.strategy, None)
    given = config.settings.model_dump()
    checked = check_parameters(config.crash_mode, chosen.pop("crash_parameters", {}))
    mode = fault_mode(config.crash_mode).name
    of_mode = {f"{mode}.{k}": v for k, v in checked.model_dump(exclude_unset=True).items()}
    of_strategy = {f"{config.strategy}.{key}": value for key, value in given.items()}
    return {**parameters, "strategy": config.strategy, **chosen, **of_strategy, **of_mode}


def relays_observations(options: UpOptions) -> bool:
    """Whether policies act on what the gate lets them see.

    Raises:
        UserError: an unknown mode, or a fault scenario that cannot be read.
    """
    faults: Sequence[FaultConfig] = (options.coach,)
    if options.fault_scenario is not None:
        faults = load_fault_scenario(options.fault_scenario).faults
    return options.gate and (
        options.relay_observations or any(is_observation_mode(f.crash_mode) for f in faults)
    )


def check_team(options: UpOptions) -> TeamSpec:
    """Loads scenario and checkpoint and returns the team.

    Raises:
        crash_coach_common.strict_yaml.ConfigError: no such scenario.
        crash_coach_common.strict_yaml.ConfigError: no such scripted team.
        policy_pkg.checkpoint.CheckpointError: no usable checkpoint, or one of another team.
    """
    env = make_env(options.scenario, 1)
    spec = env.spec
    if options.checkpoint is not None:
        scripted = scripted_name(options.checkpoint)
        if scripted is None:
            load_policy(options.checkpoint).check_spec(spec)
        else:
            make_scripted(scripted, env)
    return TeamSpec.of(spec)


def lost_after_s(options: UpOptions, dt_s: float) -> float:
    """Real time: the age at which sim and gate call a robot's command too old, seconds."""
    chosen = options.sim.get("cmd_timeout_s")
    if isinstance(chosen, int | float) and chosen > 0:
        return float(chosen)
    factor = options.sim.get("real_time_factor", 1.0)
    assert isinstance(factor, int | float)  # as the sim's parameter is declared
    return LOST_STEPS * dt_s / factor


def _acting(options: UpOptions) -> dict[str, Value]:
    """What all policy nodes of a graph have in common."""
    acting: dict[str, Value] = {
        "command_topic": "command_raw" if options.gate else "command",
        "lockstep": options.mode == "lockstep",
    }
    if options.checkpoint is None:
        acting["live"] = True
    else:
        if scripted_name(options.checkpoint) is None:
            acting["checkpoint"] = str(options.checkpoint.resolve())
        else:
            acting |= {"checkpoint": str(options.checkpoint), "scenario": options.scenario}
        acting |= {"epsilon": float(options.epsilon), "exploration_seed": options.seed}
    return acting


def graph_nodes(options: UpOptions, team: TeamSpec) -> list[Node]:
    """The graph's nodes, the sim last: the others are ready to answer when it starts.

    Raises:
        UserError: as relays_observations and placed.
    """
    acting = _acting(options)
    relays = relays_observations(options)
    if relays:
        acting["observation_topic"] = "observation_seen"
    nodes: list[Node] = []
    if options.gate:
        gate: dict[str, Value] = {
            "robots": list(team.robots),
            "lockstep": options.mode == "lockstep",
            "relay_observations": relays,
        }
        if options.mode == "realtime" and team.dt_s is not None:
            gate["cmd_timeout_s"] = lost_after_s(options, team.dt_s)
        nodes += [
            Node("gate", "crash_coach_pkg", "gate", gate),
            Node("coach", "crash_coach_pkg", "coach", coach_parameters(options, team)),
        ]
    if options.layout == "nodes":
        nodes += [
            Node(f"policy_{name}", "policy_pkg", "policy", {"robot": name, **acting})
            for name in team.robots
        ]
    else:
        nodes.append(Node("team", "policy_pkg", "team", acting))
    sim: dict[str, Value] = {
        "scenario": options.scenario,
        "mode": options.mode,
        "seed": options.seed,
        "episodes": options.episodes,
        "autostart": options.autostart,
        **options.sim,
    }
    if options.use_sim_time:
        nodes = [replace(n, parameters={**n.parameters, "use_sim_time": True}) for n in nodes]
    nodes.append(Node("sim", "sim_pkg", "sim", sim))
    return placed(nodes, options.namespace, options.params_file, options.log_level)


def placed(
    nodes: Sequence[Node], namespace: str, params_file: Path | None, log_level: str
) -> list[Node]:
    """The nodes in ``namespace``, with what all of a graph have in common.

    Raises:
        UserError: no such namespace, a parameter file that is none, or one that changes what the
            graph is built from.
    """
    space = checked_namespace(namespace)
    if params_file is not None:
        file = ParameterFile(params_file)
        for node in nodes:
            file.check(f"{space}/{node.name}", node.parameters)
        params_file = file.path
    return [
        replace(node, namespace=space, params_file=params_file, log_level=log_level)
        for node in nodes
    ]


def graph_processes(options: UpOptions, team: TeamSpec) -> list[Process]:
    """The processes of the layout. Raises GraphError where an executable is not installed."""
    nodes = graph_nodes(options, team)
    if options.layout == "single":
        return [composed_process("graph", nodes)]
    together = TOGETHER if options.layout == "team" and options.gate else ()
    processes = [node_process(node) for node in nodes if node.name not in together]
    if together:
        processes.append(composed_process("sim", [n for n in nodes if n.name in together]))
    return processes


def node_process(node: Node) -> Process:
    """The process of a node's own. Raises GraphError where its executable is not installed."""
    try:
        executable = find_executable(node.package, node.executable)
    except FileNotFoundError as error:
        raise GraphError(str(error)) from None
    return Process(node.name, (str(executable), *node.arguments()))


def composed_process(name: str, nodes: Sequence[Node]) -> Process:
    """``nodes`` in one process: parameters carry their node's name."""
    arguments = [node.name for node in nodes]
    for node in nodes:
        start = namespace_rule(node.namespace)
        arguments += ros_arguments(start, f"{node.name}:", node.parameters)
    arguments += ros_arguments([], "", {}, nodes[0].common())
    return Process(name, (*command("crash_coach_bringup.ros.composed"), *arguments))
