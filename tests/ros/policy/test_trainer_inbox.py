"""A trainer's inbox: a graph's messages, in whatever order, to episodes."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from crash_coach_interfaces.msg import Action, EpisodeState
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.bags.topics import Kind
from policy_pkg.ros.trainer.topics import RobotMessages
from policy_pkg.train.live.inbox import OPEN_EPISODES, Inbox, Lost
from sim_pkg.env import make_env
from sim_pkg.ros.convert import EpisodeWriter, ObservationWriter
from sim_pkg.session import Session

SEED = 5
ENV = make_env("buttons", 1)
SPEC = ENV.spec
Deliver = Callable[[Inbox], None]


@dataclass
class Played:
    """An episode as a sim's messages, and as what they have to become."""

    number: int
    messages: list[Deliver]
    obs: list[np.ndarray]
    actions: list[np.ndarray]
    reward: list[float]

    def deliver(self, inbox: Inbox, leave_out: int | None = None) -> None:
        for place, message in enumerate(self.messages):
            if place != leave_out:
                message(inbox)


def play(sim: Session, cut_at: int | None = None) -> Played:
    header = Header()
    episodes, observations = EpisodeWriter(SPEC, SEED, header), ObservationWriter(SPEC, header)
    rng = np.random.default_rng(3)
    sim.begin()
    played = Played(sim.episode, [], [], [], [])

    def state() -> None:
        data = serialize_message(episodes.fill(sim))
        kept = deserialize_message(data, EpisodeState)
        played.messages.append(lambda inbox: inbox.add_state(kept, data))

    def robot(kind: Kind, index: int, step: int, data: bytes) -> None:
        number = sim.episode
        played.messages.append(lambda inbox: inbox.add_raw(kind, number, step, index, data))

    state()
    while sim.running:
        step = sim.step
        if step == cut_at:
            sim.cut()
            state()
            break
        observations.fill(sim)
        played.obs.append(sim.obs.copy())
        choices = [rng.choice(np.flatnonzero(row)) for row in sim.available]
        for index, action in enumerate(choices):
            robot(Kind.OBSERVATION, index, step, observations.messages[index])
            command = Action(episode=sim.episode, step=step, action=int(action))
            robot(Kind.COMMAND, index, step, serialize_message(command))
        played.actions.append(np.array(choices, np.int32))
        sim.advance(played.actions[-1], np.zeros(SPEC.n_robots, np.uint8))
        played.reward.append(sim.reward)
        state()
    return played


@pytest.fixture
def sim() -> Session:
    return Session(ENV, SEED, 0)


@pytest.fixture
def inbox() -> Inbox:
    return Inbox("graph 0", SPEC.robots, lockstep=True, seen=False, decoder=RobotMessages())


def test_any_order_gives_the_episode_and_repetition_nothing_more(
    sim: Session, inbox: Inbox
) -> None:
    played = play(sim)
    random.Random(1).shuffle(played.messages)
    played.messages += played.messages[:9]
    played.deliver(inbox)
    assert inbox.waiting
    (recorded,) = inbox.take()
    assert isinstance(recorded, RecordedEpisode)
    assert (recorded.number, recorded.seed, recorded.robots) == (0, SEED, SPEC.robots)
    assert recorded.trajectory_hash == sim.trajectory_hash
    assert np.array_equal(recorded.episode.obs[:-1], np.array(played.obs))
    assert np.array_equal(recorded.episode.actions, np.array(played.actions))
    assert np.array_equal(recorded.episode.reward, np.array(played.reward, np.float32))
    played.deliver(inbox)  # late
    assert not inbox.waiting
    assert list(inbox.take()) == []


def test_every_single_lost_message_keeps_the_episode_open_until_it_is_given_up(
    sim: Session,
) -> None:
    played = play(sim)
    for place in range(len(played.messages)):
        inbox = Inbox("graph 0", SPEC.robots, lockstep=True, seen=False, decoder=RobotMessages())
        played.deliver(inbox, leave_out=place)
        assert list(inbox.take()) == []
        inbox.give_up(0, "10 s after its end")
        (lost,) = inbox.take()
        assert isinstance(lost, Lost)
        assert lost.number == 0
        assert lost.reason.startswith("10 s after its end: ")
        assert "step" in lost.reason or "no end" in lost.reason


def test_an_incomplete_episode_has_to_go_when_newer_ones_come(sim: Session, inbox: Inbox) -> None:
    numbers: list[tuple[type, int]] = []
    for _ in range(OPEN_EPISODES + 2):
        play(sim).deliver(inbox, leave_out=4)
        numbers += [(type(outcome), outcome.number) for outcome in inbox.take()]
    assert numbers == [(Lost, 0), (Lost, 1)]


def test_what_was_cut_short_or_cannot_be_true_is_named(sim: Session, inbox: Inbox) -> None:
    play(sim, cut_at=0).deliver(inbox)
    play(sim, cut_at=2).deliver(inbox)
    wrong = play(sim)
    other = Action(episode=2, step=0, action=(int(wrong.actions[0][0]) + 1) % SPEC.n_actions)
    lie = serialize_message(other)
    inbox.add_raw(Kind.COMMAND, 2, 0, 0, lie)
    wrong.deliver(inbox)
    reasons = {lost.number: lost.reason for lost in inbox.take() if isinstance(lost, Lost)}
    assert reasons[0] == "it was cut before its first step"
    assert set(reasons) == {0, 1, 2}
    assert "comes twice with different content" in reasons[2]


def test_nothing_older_than_the_start_is_kept(sim: Session, inbox: Inbox) -> None:
    first, second = play(sim), play(sim)
    first.deliver(inbox, leave_out=3)
    inbox.start_at(1)
    first.deliver(inbox)
    second.deliver(inbox)
    assert [outcome.number for outcome in inbox.take()] == [1]
