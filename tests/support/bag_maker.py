"""Episodes played in this process, as the arrays they gave and as the messages a graph sends."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from policy_pkg.bags.about import About
from policy_pkg.bags.recorder import stamp_ns
from policy_pkg.bags.topics import connections, load_typestore
from policy_pkg.bags.writer import BagWriter, Split
from policy_pkg.episode import Episode
from sim_pkg.env import make_env
from sim_pkg.session import Session

INTERFACES = Path(__file__).resolve().parents[2] / "ros_ws/src/crash_coach_interfaces/msg"
STORE = load_typestore(INTERFACES)
_MESSAGE = "crash_coach_interfaces/msg/"
EFFECT, WITHHELD = 1, -1


@dataclass(frozen=True)
class Sent:
    """A message on its way to a recorder."""

    topic: str
    data: bytes


@dataclass
class Made:
    """What an episode was, to hold a recording of it against."""

    number: int
    seed: int
    episode: Episode
    intents: np.ndarray
    success: bool
    sent: list[Sent] = field(default_factory=list)


class Team:
    """A session whose robots act at random, some of them muted, random or stale.

    p_fault: of each robot-step to be faulted. relay: observations pass through the gate, which
    blinds a robot now and then.
    """

    def __init__(
        self, scenario: str = "buttons", seed: int = 3, p_fault: float = 0.2, relay: bool = False
    ) -> None:
        self.env = make_env(scenario, 1)
        self.spec = self.env.spec
        self.seed, self.p_fault, self.relay = seed, p_fault, relay
        self.session = Session(self.env, seed, 0)
        self.rng = np.random.Generator(np.random.Philox(seed))
        self.about = About(
            robots=self.spec.robots,
            scenario=scenario,
            seed=seed,
            stay_actions=self.spec.stay_actions,
            dt_s=self.spec.dt_s,
            episode_limit=self.spec.episode_limit,
        )
        self.connections = connections(self.spec.robots, False, self.spec.episode_limit)

    def play(self, cut_at: int | None = None) -> Made:
        session, spec = self.session, self.spec
        session.begin()
        log = _Log(spec.n_robots)
        while session.running:
            self._look(log)
            if session.step == cut_at:
                session.cut()
                log.states[-1:] = []
                break
            self._act(log)
        if session.terminated:
            log.seen.append(np.zeros_like(session.obs))
            log.available.append(np.zeros_like(session.available))
        log.states.append(session.state.copy())
        log.send(self._state())
        episode = Episode(
            obs=np.stack(log.seen),
            state=np.stack(log.states),
            available=np.stack(log.available),
            actions=np.stack(log.actions),
            reward=np.array(log.reward, np.float32),
            faults=np.stack(log.faults),
            terminated=session.terminated,
        )
        intents = np.stack(log.intents)
        return Made(session.episode, self.seed, episode, intents, session.success, log.sent)

    def _look(self, log: _Log) -> None:
        session = self.session
        blind = self.rng.random(self.spec.n_robots) < (0.1 if self.relay else 0)
        seen = np.where(blind[:, None], np.float32(0), session.obs)
        log.blind = blind
        for kind, obs in (("observation", session.obs), ("observation_seen", seen)):
            if kind == "observation" or self.relay:
                for i, name in enumerate(self.spec.robots):
                    log.send(self._observation(f"/{name}/{kind}", i, obs[i]))
        log.seen.append(seen)
        log.states.append(session.state.copy())
        log.available.append(session.available.copy())
        log.send(self._state())

    def _act(self, log: _Log) -> None:
        session, n = self.session, self.spec.n_robots
        intents = [int(self.rng.choice(np.flatnonzero(row))) for row in session.available]
        executed, faults = list(intents), np.zeros(n, np.uint8)
        for i, name in enumerate(self.spec.robots):
            log.send(self._action(f"/{name}/command_raw", intents[i], 0))
            mode = ""
            if self.rng.random() < self.p_fault:
                mode = ("mute", "random")[int(self.rng.integers(2))]
                choice = int(self.rng.choice(np.flatnonzero(session.available[i])))
                executed[i] = choice if mode == "random" else int(session.stay()[i])
                faults[i] = 1 if mode == "mute" else 2
                applied = WITHHELD if mode == "mute" else choice
                log.send(self._effect(name, mode, intents[i], applied))
            if log.blind[i]:
                log.send(self._effect(name, "blind", -1, -2))
                faults[i] = faults[i] or 20
            if mode != "mute":
                log.send(self._action(f"/{name}/command", executed[i], int(faults[i])))
        actions = np.array(executed, np.int32)
        session.advance(actions, (faults != 0).astype(np.uint8))
        log.actions.append(actions)
        log.intents.append(np.array(intents, np.int32))
        log.faults.append(faults)
        log.reward.append(session.reward)

    def _header(self) -> Any:
        stamp_ns = round(self.session.global_step * self.spec.dt_s * 1e9)
        stamp = _type("builtin_interfaces/msg/Time")(*divmod(stamp_ns, 10**9))
        return _type("std_msgs/msg/Header")(stamp, "map")

    def _observation(self, topic: str, robot: int, features: np.ndarray) -> Sent:
        session = self.session
        return _sent(
            topic, "Observation", header=self._header(), episode=session.episode,
            step=session.step, last_action=int(session.last_actions[robot]),
            features=features.copy(), available_actions=session.available[robot].astype(np.uint8),
        )  # fmt: skip

    def _action(self, topic: str, action: int, fault: int) -> Sent:
        return _sent(
            topic, "Action", header=self._header(), episode=self.session.episode,
            step=self.session.step, action=action, worst_action=-1, fault=fault,
        )  # fmt: skip

    def _effect(self, robot: str, mode: str, intent: int, applied: int) -> Sent:
        return _sent(
            "/coach/events", "FaultEvent", header=self._header(), kind=EFFECT,
            episode=self.session.episode, step=self.session.step, revision=1, robot=robot,
            mode=mode, entry=0, intent=intent, applied=applied, detail="",
        )  # fmt: skip

    def _state(self) -> Sent:
        session = self.session
        return _sent(
            "/sim/episode", "EpisodeState", header=self._header(), episode=session.episode,
            step=session.step, seed=self.seed, state=session.state.copy(),
            reward=session.reward, episode_return=session.episode_return,
            terminated=session.terminated, truncated=session.truncated, success=session.success,
            crashed=session.crashed.copy(),
            actions=session.last_actions.copy() if session.step else np.zeros(0, np.int32),
            positions_m=self.env.positions_m[0].ravel().copy(),
            trajectory_hash=session.trajectory_hash,
        )  # fmt: skip


class _Log:
    def __init__(self, n: int) -> None:
        self.sent: list[Sent] = []
        self.seen: list[np.ndarray] = []
        self.states: list[np.ndarray] = []
        self.available: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []
        self.intents: list[np.ndarray] = []
        self.faults: list[np.ndarray] = []
        self.reward: list[float] = []
        self.blind = np.zeros(n, bool)

    def send(self, sent: Sent) -> None:
        self.sent.append(sent)


def _type(name: str) -> Any:
    return STORE.types[name]


def _sent(topic: str, msgtype: str, **fields: Any) -> Sent:
    message = _type(_MESSAGE + msgtype)(**fields)
    return Sent(topic, bytes(STORE.serialize_cdr(message, _MESSAGE + msgtype)))


def change(sent: Sent, msgtype: str, **fields: Any) -> Sent:
    """The same message with other values."""
    message = STORE.deserialize_cdr(sent.data, _MESSAGE + msgtype)
    for name, value in fields.items():
        setattr(message, name, value)
    return Sent(sent.topic, bytes(STORE.serialize_cdr(message, _MESSAGE + msgtype)))


def messages(made: Iterable[Made]) -> list[Sent]:
    return [sent for one in made for sent in one.sent]


def write(
    folder: Path,
    team: Team,
    sent: Sequence[Sent],
    split: Split | None = None,
    compression: str = "zstd",
    ends: bool = True,
    about: About | None = None,
    flush_every: int = 200,
) -> Path:
    """A recording of the messages. ends: closed properly; otherwise as a kill leaves it."""
    now = count()
    writer = BagWriter(
        folder, team.connections, STORE, about or team.about, lambda: float(next(now)),
        split, compression, flush_s=flush_every,
    )  # fmt: skip
    index = {c.topic: i for i, c in enumerate(team.connections)}
    for number, one in enumerate(sent):
        writer.write(index[one.topic], 10**18 + number, stamp_ns(one.data, 0), one.data)
        if split is not None and split.episodes and one.topic == "/sim/episode":
            state = STORE.deserialize_cdr(one.data, _MESSAGE + "EpisodeState")
            if state.terminated or state.truncated:
                writer.episode_ended()
        writer.tick()
    if ends:
        writer.close()
    return folder


def played(team: Team, episodes: int) -> list[Made]:
    return [team.play() for _ in range(episodes)]
