"""Does an environment keep what a scenario promises? For authors of scenarios, and our tests."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from crash_coach_common.contract import BatchEnv, BoolArray, IntArray, StepResult
from sim_pkg.trajectory import TrajectoryHash

SHOWN = 3  # complaints of one kind


@dataclass(frozen=True)
class Check:
    """One promise: whether it was kept, and what was seen."""

    name: str
    kept: bool
    told: str


@dataclass
class _Play:
    """What was seen in the episodes of one environment; ``wrong``: complaints by check."""

    hashes: dict[int, str] = field(default_factory=dict)
    steps: int = 0
    seconds: float = 0.0
    successes: int = 0
    wrong: dict[str, list[str]] = field(default_factory=dict)

    def complain(self, check: str, text: str) -> None:
        self.wrong.setdefault(check, []).append(text)


MakeEnv = Callable[[int], BatchEnv]


def check_env(make: MakeEnv, episodes: int = 4, seed: int = 0) -> list[Check]:
    """Plays episodes 0 .. ``episodes`` - 1 with random available actions, alone and side by side.

    make: makes the environment with a number of arenas.

    Raises:
        UserError: it cannot be made or played at all.
    """
    spec = make(1).spec
    alone, together = _played(make(1), episodes, seed), _played(make(episodes), episodes, seed)
    differing = [e for e in range(episodes) if alone.hashes.get(e) != together.hashes.get(e)]
    wrong = {
        name: alone.wrong.get(name, []) + together.wrong.get(name, [])
        for name in ("masks", "bounds", "leaving", "ends", "success")
    }
    wrong["seeds"] = [
        f"episode {e} of seed {seed}: another course when it is played again beside others"
        for e in differing
    ]
    low, high = spec.bounds
    kept = {
        "masks": "every robot always has an action, and one with which it stays",
        "bounds": f"observations and state are finite and within {low:g}..{high:g}",
        "seeds": f"{episodes} episodes repeat bit for bit, alone and side by side",
        "leaving": "a robot that is out of the episode stays out",
        "ends": f"episodes end within {spec.episode_limit} steps, once; rewards are finite",
        "success": f"{together.successes} of {episodes} episodes with random actions succeed"
        if spec.reports_success
        else "the scenario does not say what a success is",
    }
    checks = [
        Check(name, not wrong[name], "; ".join(wrong[name][:SHOWN]) or text)
        for name, text in kept.items()
    ]
    speed = together.steps / max(together.seconds, 1e-9)
    return [*checks, Check("speed", True, f"{speed:,.0f} steps per second, {episodes} arenas")]


def _played(env: BatchEnv, episodes: int, seed: int) -> _Play:
    play = _Play()
    for first in range(0, episodes, env.n_arenas):
        _batch(env, range(first, min(first + env.n_arenas, episodes)), seed, play)
    return play


def _batch(env: BatchEnv, episodes: range, seed: int, play: _Play) -> None:
    """One episode in each arena, all begun at once."""
    spec, count = env.spec, len(episodes)
    env.reset(np.arange(count), seed, np.array(episodes, dtype=np.int64))
    rngs = [np.random.default_rng([seed, episode]) for episode in episodes]
    hashes = [TrajectoryHash(seed, episode) for episode in episodes]
    running = np.arange(env.n_arenas) < count
    gone = np.zeros((env.n_arenas, spec.n_robots), dtype=np.bool_)
    for step in range(spec.episode_limit + 1):
        if not running.any():
            return
        if step == spec.episode_limit:
            play.complain("ends", f"still going on after {step} steps")
            return
        gone = _look(env, running, gone, step, play)
        if play.wrong.get("masks"):
            return  # nobody could choose an action
        actions = _chosen(env, running, rngs)
        for i in np.flatnonzero(running).tolist():
            hashes[i].observe(env.obs[i], env.state[i])
        start_s = time.perf_counter()
        result = env.step(actions)
        play.seconds += time.perf_counter() - start_s
        play.steps += int(running.sum())
        ended = _judge(result, running, step, play)
        for i in np.flatnonzero(running).tolist():
            flags = (bool(a[i]) for a in (result.terminated, result.truncated, result.success))
            hashes[i].act(actions[i], float(result.reward[i]), *flags)
            if ended[i]:
                play.hashes[episodes[i]] = hashes[i].hexdigest()
                play.successes += int(result.success[i])
        running = running & ~ended


def _judge(result: StepResult, running: BoolArray, step: int, play: _Play) -> BoolArray:
    """Complains of what a step reports; (B,) the arenas whose episode it ended."""
    ended: BoolArray = result.terminated | result.truncated
    if (result.terminated & result.truncated).any():
        play.complain("ends", f"step {step}: terminated and truncated at once")
    if not np.isfinite(result.reward).all():
        play.complain("ends", f"step {step}: reward {result.reward.tolist()}")
    if (result.reward[~running] != 0).any() or ended[~running].any():
        play.complain("ends", f"step {step}: an arena that had ended reports something")
    if (result.success & ~ended).any():
        play.complain("success", f"step {step}: a success before the end")
    return ended


def _look(env: BatchEnv, running: BoolArray, gone: BoolArray, step: int, play: _Play) -> BoolArray:
    """Complains of what is seen before a step; (B, n) the robots that are out of their episode."""
    spec, available = env.spec, env.available[running]
    if not available.any(axis=-1).all():
        play.complain("masks", f"step {step}: a robot without any action")
    elif not available[..., list(spec.stay_actions)].any(axis=-1).all():
        play.complain("masks", f"step {step}: a robot that cannot stay")
    low, high = spec.bounds
    for name, values in (("observation", env.obs[running]), ("state", env.state[running])):
        if not np.isfinite(values).all() or values.min() < low or values.max() > high:
            play.complain(
                "bounds", f"step {step}: {name} from {values.min():g} to {values.max():g}"
            )
    told = getattr(env, "alive", None)
    if told is not None:
        now = np.stack([~told(arena) for arena in range(env.n_arenas)])
    else:  # of ours, the dead have the no-op alone
        noop = spec.stay_actions[0]
        now = (env.available.sum(axis=-1) == 1) & env.available[..., noop]
    if (gone & ~now)[running].any():
        play.complain("leaving", f"step {step}: a robot that was out of the episode is back")
    out: BoolArray = now
    return out


def _chosen(env: BatchEnv, running: BoolArray, rngs: list[np.random.Generator]) -> IntArray:
    """(B, n) random available actions, drawn for each episode on its own."""
    actions: IntArray = np.zeros((env.n_arenas, env.spec.n_robots), dtype=np.int32)
    for i in np.flatnonzero(running).tolist():
        for robot, mask in enumerate(env.available[i]):
            actions[i, robot] = rngs[i].choice(np.flatnonzero(mask))
    return actions
