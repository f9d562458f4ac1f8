"""What is recorded: topics, their types and what their messages are to the reader."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from crash_coach_common.contract import UserError

INTERFACES = "crash_coach_interfaces"
EPISODE_TOPIC = "/sim/episode"
_FOREVER = QosTime(0x7FFFFFFF, 0xFFFFFFFF)


class Kind(Enum):
    """What a topic's messages say. Values: the end of a robot's topic, or the whole name."""

    OBSERVATION = "observation"
    SEEN = "observation_seen"
    INTENT = "command_raw"
    COMMAND = "command"
    STATE = EPISODE_TOPIC
    PLAN = "/coach/plan"
    EVENT = "/coach/events"


TYPES = {
    Kind.OBSERVATION: f"{INTERFACES}/msg/Observation",
    Kind.SEEN: f"{INTERFACES}/msg/Observation",
    Kind.INTENT: f"{INTERFACES}/msg/Action",
    Kind.COMMAND: f"{INTERFACES}/msg/Action",
    Kind.STATE: f"{INTERFACES}/msg/EpisodeState",
    Kind.PLAN: f"{INTERFACES}/msg/CrashPlan",
    Kind.EVENT: f"{INTERFACES}/msg/FaultEvent",
}
OF_ROBOT = (Kind.OBSERVATION, Kind.SEEN, Kind.INTENT, Kind.COMMAND)


def kind_of(topic: str) -> tuple[Kind, str] | None:
    """(kind, robot or '') of a topic; None for one that the reader does not need."""
    parts = topic.split("/")
    if len(parts) == 3 and parts[1] and not parts[1].startswith("_"):  # hidden: of the team
        for kind in OF_ROBOT:
            if kind.value == parts[2]:
                return kind, parts[1]
    for kind in (Kind.STATE, Kind.PLAN, Kind.EVENT):
        if kind.value == topic:
            return kind, ""
    return None


@dataclass(frozen=True)
class Connection:
    """One recorded topic, and the QoS that its publishers offer."""

    topic: str
    msgtype: str
    depth: int
    latched: bool = False

    def qos(self) -> Qos:
        durability = QosDurability.TRANSIENT_LOCAL if self.latched else QosDurability.VOLATILE
        return Qos(
            QosHistory.KEEP_LAST, self.depth, QosReliability.RELIABLE, durability,
            _FOREVER, _FOREVER, QosLiveliness.AUTOMATIC, _FOREVER, False,
        )  # fmt: skip


def connections(
    robots: tuple[str, ...], odometry: bool, episode_limit: int
) -> tuple[Connection, ...]:
    """Everything that the recorder records of a team; docs/ros.md has the offered QoS.

    odometry: also /<robot>/odom, which the sim builds only while somebody listens.
    """
    out = [Connection(EPISODE_TOPIC, TYPES[Kind.STATE], max(episode_limit, 1) + 1, latched=True)]
    out += [
        Connection(f"/{robot}/{kind.value}", TYPES[kind], 1)
        for robot in robots
        for kind in OF_ROBOT
    ]
    out.append(Connection(Kind.PLAN.value, TYPES[Kind.PLAN], 1, latched=True))
    out.append(Connection(Kind.EVENT.value, TYPES[Kind.EVENT], 100))
    out.append(Connection("/clock", "rosgraph_msgs/msg/Clock", 10))
    if odometry:
        out += [Connection(f"/{robot}/odom", "nav_msgs/msg/Odometry", 10) for robot in robots]
    return tuple(out)


def load_typestore(folder: Path) -> Typestore:
    """Jazzy's message types, and ours from the .msg files in ``folder``.

    Raises:
        UserError: there are none.
    """
    files = sorted(folder.glob("*.msg"))
    if not files:
        raise UserError(f"no .msg file in {folder}: build the workspace (make setup)")
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in files:
        store.register(get_types_from_msg(path.read_text(), f"{INTERFACES}/msg/{path.stem}"))
    return store
