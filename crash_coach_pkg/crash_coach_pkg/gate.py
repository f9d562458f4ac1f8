"""Applies faults to commands: one path for rollouts, evaluation and the gate node.

Random actions come from a counter-based generator keyed by (seed, episode, step, robot), so
neither arrival order nor batching can change them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from crash_coach_pkg.plan import Mode
from sim_pkg.contract import BoolArray, EpisodeArray, IntArray

UInt64Array = npt.NDArray[np.uint64]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)


def _splitmix64(x: UInt64Array) -> UInt64Array:
    """The finaliser of SplitMix64 (Steele, Lea, Flood 2014), element by element."""
    x = x + _GOLDEN
    x = (x ^ (x >> np.uint64(30))) * _MIX_1
    x = (x ^ (x >> np.uint64(27))) * _MIX_2
    return x ^ (x >> np.uint64(31))


def random_bits(
    seed: int, episode: npt.ArrayLike, step: npt.ArrayLike, robot: npt.ArrayLike
) -> UInt64Array:
    """64 uniform bits for each (episode, step, robot); these broadcast together, at least 1-d."""
    key = _splitmix64(np.atleast_1d(np.uint64(seed)))
    for counter in (episode, step, robot):
        key = _splitmix64(key ^ np.asarray(counter).astype(np.uint64))
    return key


def random_available(bits: UInt64Array, available: BoolArray) -> IntArray:
    """(...,) bits, (..., A) availability -> (...,) uniformly chosen available action."""
    counts = available.sum(axis=-1).astype(np.uint64)
    pick = ((bits >> np.uint64(32)) * counts) >> np.uint64(32)
    order = np.cumsum(available, axis=-1)
    chosen: IntArray = np.argmax(order > pick[..., None].astype(np.int64), axis=-1).astype(np.int32)
    return chosen


def apply_faults(
    intent: IntArray,
    modes: npt.NDArray[np.uint8],
    available: BoolArray,
    stay: IntArray,
    seed: int,
    episode: EpisodeArray,
    step: EpisodeArray,
) -> IntArray:
    """The executed actions of B teams.

    Args:
        intent: (B, n) what the policies want.
        modes: (B, n) Mode in force.
        available: (B, n, A).
        stay: (B, n) the no-move action of each robot: what a muted robot executes.
        seed, episode, step: keys of the random actions; episode and step are (B,).

    Returns:
        (B, n) int32.
    """
    applied = np.where(modes == Mode.MUTE, stay, intent)
    randomised = modes == Mode.RANDOM
    if randomised.any():
        robots = np.arange(intent.shape[1], dtype=np.int32)[None, :]
        bits = random_bits(seed, episode[:, None], step[:, None], robots)
        applied = np.where(randomised, random_available(bits, available), applied)
    return applied.astype(np.int32, copy=False)
