"""The sim node's publishers and subscriptions, and whether anybody is at their other ends."""

from __future__ import annotations

import time
from collections.abc import Callable

from crash_coach_interfaces.msg import EpisodeState, FaultEvent
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from crash_coach_common.contract import EnvSpec, UserError
from crash_coach_common.ros.peers import several
from crash_coach_common.ros.qos import latched
from crash_coach_common.ros.team_topics import COMMANDS, OBSERVATIONS, TeamPublisher, subscribe
from crash_coach_common.team_cdr import RobotMessage
from sim_pkg.lockstep import Decisions
from sim_pkg.realtime import NewestCommands
from sim_pkg.ros import convert
from sim_pkg.ros.arena_view import ArenaView
from sim_pkg.ros.transforms import Transforms
from sim_pkg.session import Session

EPISODE_TOPIC = "sim/episode"
# The same, only where an episode begins or ends: the coach need not wake at every step.
BOUNDARY_TOPIC = "sim/boundary"
EVENTS_TOPIC = "coach/events"
_ACK_TIMEOUT_S = 5.0


class SimTopics:
    """Everything that the sim sends and receives on topics."""

    def __init__(
        self,
        node: Node,
        arena: ArenaView,
        spec: EnvSpec,
        seed: int,
        on_commands: Callable[[list[RobotMessage]], None],
        on_error: Callable[[UserError], None],
        on_event: Callable[[FaultEvent], None],
        lockstep: bool,
    ) -> None:
        self._node = node
        self._arena = arena
        self._spec = spec
        self._period_ns = convert.step_period_ns(spec.dt_s)
        self._header = Header(frame_id=convert.MAP_FRAME)
        self._observations = convert.ObservationWriter(spec, self._header)
        self._episode = convert.EpisodeWriter(spec, seed, self._header)
        self._clock = Clock(clock=self._header.stamp)
        # A whole episode, so that a reader that falls behind within one loses nothing of it.
        episode = latched(spec.episode_limit + 1)
        pub = node.create_publisher
        self._episode_pub = pub(EpisodeState, EPISODE_TOPIC, episode)
        self._boundary_pub = pub(EpisodeState, BOUNDARY_TOPIC, episode)
        self._clock_pub = pub(Clock, "clock", QoSProfile(depth=10))
        self._markers_pub = pub(MarkerArray, "sim/markers", QoSProfile(depth=10))
        self._diagnostics_pub = pub(DiagnosticArray, "diagnostics", QoSProfile(depth=10))
        observed = [f"{robot}/observation" for robot in spec.robots]
        self._obs_pub = TeamPublisher(node, OBSERVATIONS, spec.robots, observed, "observation")
        self._odom_pubs = [pub(Odometry, f"{r}/odom", QoSProfile(depth=10)) for r in spec.robots]
        commanded = [f"{robot}/command" for robot in spec.robots]
        self._command_subs = subscribe(
            node, COMMANDS, spec.robots, commanded, "command", on_commands, on_error, lockstep
        )
        node.create_subscription(FaultEvent, EVENTS_TOPIC, on_event, QoSProfile(depth=100))
        self._transforms = Transforms(node, spec.robots, convert.MAP_FRAME)
        self._draw = False
        self._odom: list[int] = []

    def refresh_listeners(self) -> None:
        """Notes who listens to what is built on demand only (odometry, TF, markers)."""
        self._draw = self._markers_pub.get_subscription_count() > 0
        self._arena.refresh_listeners()
        self._obs_pub.look()
        self._transforms.refresh_listeners()
        self._odom = [
            i for i, pub in enumerate(self._odom_pubs) if pub.get_subscription_count() > 0
        ]

    def unmatched(self) -> list[str]:
        """Topics that nobody listens on (observations) or publishes (commands)."""
        missing = []
        for pub, sub in zip(self._obs_pub.robots, self._command_subs, strict=True):
            if pub.get_subscription_count() == 0:
                missing.append(f"{pub.topic_name} has no subscriber")
            if sub.get_publisher_count() == 0:
                missing.append(f"{sub.topic_name} has no publisher")
        return missing

    def publish_step(self, session: Session) -> None:
        """Everything about the situation before (or at the end, after) a control step."""
        convert.set_time(self._header.stamp, session.global_step * self._period_ns)
        self._clock_pub.publish(self._clock)
        if session.running and session.step > 0:
            # The policies work while the rest is published.
            self._observe(session)
            self._episode_pub.publish(self._episode.fill(session))
        else:
            # A new episode: its plan takes longest. An ended one: nothing to observe.
            state = self._episode.fill(session)
            self._boundary_pub.publish(state)
            self._episode_pub.publish(state)
            if session.running:
                self._observe(session)
        self._arena.look(session, self._header)
        self._transforms.look(session, self._header)
        if self._draw:
            self._markers_pub.publish(convert.markers(session, self._header))
        for robot in self._odom:
            self._odom_pubs[robot].publish(convert.odometry(session, self._header, robot))

    def catch_up(self, session: Session) -> None:
        """Shows viewers the newest state where it came too soon after the one before it."""
        self._arena.catch_up(session, self._header)

    def _observe(self, session: Session) -> None:
        self._observations.fill(session)
        self._obs_pub.publish(list(enumerate(self._observations.messages)))

    def observe_again(self, robots: list[int]) -> None:
        """The current step's observations once more to some robots."""
        self._obs_pub.publish_alone([(i, self._observations.messages[i]) for i in robots])

    def publish_diagnostics(self, decided: Decisions | NewestCommands, session: Session) -> None:
        """Stamped with wall time: it is about processes, not about the simulated world."""
        stamp = self._node.get_clock().now().to_msg()
        sims = self.rivals()
        problems = [
            "; ".join(filter(None, (sims, several(self._node, f"{robot}/command"))))
            for robot in self._spec.robots
        ]
        self._diagnostics_pub.publish(convert.diagnostics(decided, session, stamp, problems))

    def rivals(self) -> str:
        """Who else plays the sim here; '' where nobody does."""
        return several(self._node, EPISODE_TOPIC)

    def flush(self) -> None:
        """Waits, within bounds, until every reader has the last episode state and boundary."""
        deadline_s = time.monotonic() + _ACK_TIMEOUT_S
        for publisher in (self._episode_pub, self._boundary_pub):
            left_s = max(0.0, deadline_s - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left_s))
