"""The node behind both executables: an Agent between observation and command topics."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from rclpy.context import Context

from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos_node import QosNode
from crash_coach_common.ros.run_node import run, serving
from crash_coach_common.ros.team_topics import COMMANDS, OBSERVATIONS, TeamPublisher, subscribe
from crash_coach_common.team_cdr import RobotMessage
from policy_pkg.act import Exploration, best_and_worst
from policy_pkg.agent import Agent, Answer
from policy_pkg.checkpoint import load_policy
from policy_pkg.ros.agent_params import PolicyParameters, TeamParameters, read_parameters
from policy_pkg.ros.convert import bytes_from_answer, sensed_from_bytes
from policy_pkg.ros.weights_link import Receive, WeightsLink
from policy_pkg.team_name import scripted_name

if TYPE_CHECKING:
    from policy_pkg.play.scripted_agent import ScriptedAgent


class AgentNode(QosNode):
    """Acts on /<robot>/<observation_topic>, answers on /<robot>/<command_topic>.

    Raises:
        UserError: a parameter is missing, unknown or wrong (CheckpointError for the checkpoint).
    """

    def __init__(self, name: str, one_robot: bool, context: Context | None = None) -> None:
        super().__init__(name, context=context, start_parameter_services=False)
        parameters = read_parameters(self, PolicyParameters if one_robot else TeamParameters)
        robots = (parameters.robot,) if isinstance(parameters, PolicyParameters) else ()
        self._topics = (parameters.observation_topic, parameters.command_topic)
        self._lockstep = parameters.lockstep
        self.failure: UserError | None = None
        """Why the node has to end; an exception in a callback would be told with a traceback."""
        if parameters.live:
            self._link = WeightsLink(self, robots, self._act_for)
            return
        agent = make_agent(parameters, robots)
        self._act_for(agent.robots, agent.receive)

    def _act_for(self, robots: tuple[str, ...], receive: Receive) -> None:
        """Opens the topics of ``robots``; ``receive`` answers their observations."""
        observation_topic, command_topic = self._topics
        self._receive = receive
        commands = [f"{name}/{command_topic}" for name in robots]
        observations = [f"{name}/{observation_topic}" for name in robots]
        self._commands = TeamPublisher(self, COMMANDS, robots, commands, command_topic)
        subscribe(
            self,
            OBSERVATIONS,
            robots,
            observations,
            observation_topic,
            self._on_observations,
            self._on_error,
            self._lockstep,
        )
        self.get_logger().info(f"ready: acts for {', '.join(robots)}")

    def _on_error(self, error: UserError) -> None:
        self.failure = error

    def _on_observations(self, messages: list[RobotMessage]) -> None:
        answers: list[Answer[bytes]] = []
        try:
            for robot, data in messages:
                answers += self._receive(robot, sensed_from_bytes(data))
        except UserError as error:
            self.failure = error
            return
        self._commands.publish([(it.robot, bytes_from_answer(it)) for it in answers])


def make_agent(
    parameters: TeamParameters, robots: tuple[str, ...]
) -> Agent[bytes] | ScriptedAgent[bytes]:
    """A trained team's agent or a scripted one's, for ``robots``; for none of them: for all.

    Raises:
        UserError: a checkpoint, scenario, scripted policy or robot that is not there.
    """
    seed = parameters.exploration_seed
    scripted = scripted_name(parameters.checkpoint)
    agent: Agent[bytes] | ScriptedAgent[bytes]
    if scripted is not None:
        # It reads its observations as the simulator lays them out; a trained team does without.
        from policy_pkg.play.scripted_agent import ScriptedAgent

        agent = ScriptedAgent(scripted, parameters.scenario, robots, seed)
        n_robots = agent.n_robots
    else:
        bundle = load_policy(parameters.checkpoint)
        n_robots = len(bundle.robots)
        agent = Agent(
            bundle.policy,
            bundle.robots,
            robots or bundle.robots,
            bundle.obs_size,
            bundle.n_actions,
            best_and_worst,
        )
    agent.exploration = Exploration(parameters.epsilon, seed, n_robots)
    return agent


def spin(make_node: Callable[[], AgentNode]) -> int:
    """Runs a node until SIGINT or SIGTERM; returns the exit code, 1 after one line of error."""

    def body(received: list[int]) -> None:
        with serving() as served:
            node = served.add(make_node())

            def done() -> object:
                if node.failure is not None:
                    raise node.failure
                return received

            served.until(done)

    return run(body)
