"""Recorded episodes for training: bags to Episodes, each held against its trajectory hash."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import IntArray, UserError
from crash_coach_pkg.faults import mode_code
from crash_coach_pkg.plan import CrashPlan
from policy_pkg.bags.about import About, same_scenario
from policy_pkg.bags.assemble import (
    ContradictionError,
    IncompleteError,
    Joined,
    Wanted,
    assemble,
    counts_suffice,
)
from policy_pkg.bags.bag import Bag, Scan, find_bags
from policy_pkg.bags.crash_plan import read_plan
from policy_pkg.bags.join import MEMORY_BYTES, Joiner, Pieces
from policy_pkg.bags.problems import BagError, Problem, Report, Severity, refuse
from policy_pkg.bags.topics import Kind
from policy_pkg.episode import Episode
from sim_pkg.trajectory import TrajectoryHash

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordedEpisode:
    """An episode of a bag.

    ``episode.obs`` is what the policies saw; its entry T, and that of ``available``, is zero where
    the episode terminated: nobody observes there, and the learner multiplies it by zero.
    """

    bag: str
    robots: tuple[str, ...]
    seed: int
    number: int
    episode: Episode
    intents: IntArray  # (T, n) actions that the policies wanted; -1 where not recorded
    success: bool
    plan: CrashPlan | None  # last revision that came before the episode was complete, if any
    modes: dict[tuple[int, int], str]  # names of faults by (step, robot)
    trajectory_hash: str
    scenario: str = ""  # name or file, as the recorder was told; "": not told


@dataclass
class BagSummary:
    """What a bag holds, complete once its episodes have been read."""

    name: str
    files: int
    robots: tuple[str, ...]
    about: About | None
    messages: int = 0
    repeated: int = 0  # messages that say nothing new of a robot-step; harmless
    disordered: int = 0  # messages received before the one before them in the file; harmless
    duration_s: float = 0.0
    episodes: int = 0
    steps: int = 0
    successes: int = 0
    crashed_robot_steps: dict[str, int] = field(default_factory=dict)  # by mode
    crashed_episodes: int = 0

    def count(self, recorded: RecordedEpisode) -> None:
        self.episodes += 1
        self.steps += recorded.episode.length
        self.successes += recorded.success
        self.crashed_episodes += bool(recorded.modes)
        for mode in recorded.modes.values():
            self.crashed_robot_steps[mode] = self.crashed_robot_steps.get(mode, 0) + 1


def warn(problem: Problem) -> None:
    """A Report that logs."""
    _log.warning("%s", problem)


def load_episodes(
    paths: Sequence[Path],
    strict: bool = False,
    report: Report = warn,
    memory_bytes: int = MEMORY_BYTES,
) -> Iterator[RecordedEpisode]:
    """Every complete episode of the bags in ``paths``, in the order in which they are complete.

    Holds about one episode at a time: at most ``memory_bytes`` of messages.

    Args:
        paths: MCAP files, folders of recordings, folders of such folders.
        strict: the first problem ends the reading; otherwise each is reported, and the episodes
            that it concerns are left out.

    Raises:
        BagError: no recording in a path; bags of different teams or scenarios; with ``strict``,
            any problem.
    """
    team: tuple[str, ...] = ()
    scenario, told_by = "", ""
    for bag in find_bags(paths):
        reading = BagReading(bag, refuse if strict else report, memory_bytes)
        if team and reading.summary.robots and reading.summary.robots != team:
            raise BagError(
                f"{bag.name}: its robots are {', '.join(reading.summary.robots)}; "
                f"those of the bags before are {', '.join(team)}"
            )
        team = team or reading.summary.robots
        if not same_scenario(reading.scenario, scenario):
            raise BagError(
                f"{bag.name}: recorded on scenario {reading.scenario!r}, {told_by} on "
                f"{scenario!r}: a data set is of one scenario"
            )
        if not scenario:
            scenario, told_by = reading.scenario, bag.name
        yield from reading.episodes()


class BagReading:
    """Reads one bag once; ``summary`` grows with ``episodes``."""

    def __init__(self, bag: Bag, report: Report, memory_bytes: int = MEMORY_BYTES) -> None:
        self._scan = scan = Scan(bag)
        self._joiner = Joiner(bag, scan, report, memory_bytes)
        self._report = report
        self.summary = BagSummary(bag.name, len(bag.files), scan.robots, scan.about)

    @property
    def scenario(self) -> str:
        """As the recorder was told; "" where it was not."""
        return self._scan.about.scenario if self._scan.about is not None else ""

    def episodes(self) -> Iterator[RecordedEpisode]:
        joiner, summary = self._joiner, self.summary
        for pieces, last in joiner.pieces():
            recorded = self._finished(pieces, last)
            if recorded is not None:
                recorded = replace(recorded, scenario=self.scenario)
                summary.count(recorded)
                yield recorded
        summary.about = joiner.about
        summary.messages = joiner.messages
        summary.repeated, summary.disordered = joiner.repeated, joiner.disordered
        summary.duration_s = (joiner.last_ns - joiner.first_ns) * 1e-9
        self._check_topics()

    def _finished(self, pieces: Pieces, last: bool) -> RecordedEpisode | None:
        """The episode, once nothing more of it can come; None also where it is left out."""
        robots, joiner = self._scan.robots, self._joiner
        wanted = self._wanted()
        if not last and not counts_suffice(pieces, len(robots), wanted):
            return None
        place = f"{self.summary.name}: episode {pieces.number}"
        try:
            if pieces.end is not None and pieces.end.step == 0 and not pieces.conflicts:
                recorded = None  # cut short before its first step
            else:
                joined = assemble(pieces, robots, wanted, joiner.decoder, last)
                about = joiner.about
                realtime = about is not None and about.mode == "realtime"
                recorded = recorded_episode(self.summary.name, robots, pieces, joined, realtime)
        except IncompleteError as error:
            if not last:
                return None
            recorded = None
            self._report(Problem(place, f"left out: {error}", Severity.INCOMPLETE))
        except (ContradictionError, UserError, ValueError) as error:
            recorded = None
            self._report(Problem(place, f"left out: {error}"))
        joiner.close(pieces)
        return recorded

    def _wanted(self) -> Wanted:
        about, kinds, met = self._joiner.about, self._scan.kinds, self._joiner.met
        return Wanted(
            decisions=about is not None and about.mode == "lockstep",
            effects=Kind.EVENT in kinds,
            seen=Kind.SEEN in met | self._scan.certain,
            intents=Kind.INTENT in kinds,
        )

    def _check_topics(self) -> None:
        met = self._joiner.met
        for kind, topic in (
            (Kind.STATE, "/sim/episode"),
            (Kind.OBSERVATION, "/<robot>/observation"),
            (Kind.COMMAND, "/<robot>/command"),
        ):
            if kind not in met:
                self._joiner.problem(f"missing topic: no message on {topic}")


def recorded_episode(
    name: str, robots: tuple[str, ...], pieces: Pieces, joined: Joined, realtime: bool
) -> RecordedEpisode:
    """The episode, held against its trajectory hash.

    Raises:
        ContradictionError, IncompleteError: what is wrong, or missing.
        ValueError: a plan or fault that does not exist.
    """
    end = joined.end
    _check_hash(joined)
    episode = Episode(
        obs=joined.seen,
        state=joined.state,
        available=joined.available,
        actions=joined.executed,
        reward=joined.reward.astype(np.float32),
        faults=_faults(joined, robots, realtime),
        terminated=bool(end.terminated),
    )
    return RecordedEpisode(
        bag=name,
        robots=robots,
        seed=int(end.seed),
        number=pieces.number,
        episode=episode,
        intents=joined.intents,
        success=bool(end.success),
        plan=read_plan(pieces.plan, robots) if pieces.plan is not None else None,
        modes={**joined.observed, **joined.modes},
        trajectory_hash=end.trajectory_hash,
    )


def _check_hash(joined: Joined) -> None:
    """Raises ContradictionError where the arrays are not those that the sim hashed."""
    end, steps = joined.end, len(joined.reward)
    if not end.trajectory_hash:
        raise ContradictionError("its last EpisodeState has no trajectory hash")
    # Flags before the end are false; an end that was cut from outside is not hashed.
    digest = TrajectoryHash(end.seed, end.episode)
    cut = bool(end.truncated)
    for step in range(steps):
        digest.observe(joined.truth[step], joined.state[step])
        last = step == steps - 1 and not cut
        flags = (bool(end.terminated), False, bool(end.success)) if last else (False,) * 3
        digest.act(joined.executed[step], float(joined.reward[step]), *flags)
    if cut:
        digest.observe(joined.truth[steps], joined.state[steps])
    if digest.hexdigest() != end.trajectory_hash:
        raise ContradictionError(
            f"its data do not give its trajectory hash {end.trajectory_hash[:12]}..."
        )


def _faults(joined: Joined, robots: tuple[str, ...], realtime: bool) -> npt.NDArray[np.uint8]:
    """(T, n) fault codes of the robot-steps that the sim marks as crashed.

    In real time a faulted command may serve for several steps, so its code does too.
    """
    codes = joined.codes.copy()
    for key, mode in {**joined.observed, **joined.modes}.items():
        code, (step, robot) = mode_code(mode), key
        if codes[key] == 0:
            codes[key] = code
        elif codes[key] != code and key not in joined.modes:
            raise IncompleteError(f"no EFFECT event of {robots[robot]}'s step {step}")
        elif codes[key] != code:
            raise ContradictionError(
                f"{robots[robot]}, step {step}: fault code {codes[key]} in the command, "
                f"{code} ({mode}) in the EFFECT"
            )
    if realtime:
        for step in range(1, len(codes)):
            late = joined.crashed[step] & (codes[step] == 0)
            codes[step, late] = codes[step - 1, late]
    unnamed = np.argwhere(joined.crashed & (codes == 0))
    if len(unnamed):
        step, robot = (int(value) for value in unnamed[0])
        raise IncompleteError(f"no EFFECT event of {robots[robot]}'s step {step}, which crashed")
    codes[~joined.crashed] = 0
    return codes
