"""Faults of whole batches of commands: the fast path of training for mute and random.

TeamFaults does the same for one robot-step and every mode; a test holds the two together.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, EpisodeArray, IntArray
from crash_coach_common.keyed_random import UInt64Array, random_bits

MUTE_CODE = 1
RANDOM_CODE = 2


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
    seed: npt.ArrayLike,
    episode: EpisodeArray,
    step: EpisodeArray,
) -> IntArray:
    """The executed actions of B teams.

    Args:
        intent: (B, n) what the policies want.
        modes: (B, n) code of the fault in force: 0, MUTE_CODE or RANDOM_CODE.
        available: (B, n, A).
        stay: (B, n) the no-move action of each robot: what a muted robot executes.
        seed, episode, step: keys of the random actions; seed is one or (B, 1), the others (B,).

    Returns:
        (B, n) int32.
    """
    applied = np.where(modes == MUTE_CODE, stay, intent)
    randomised = modes == RANDOM_CODE
    if randomised.any():
        robots = np.arange(intent.shape[1], dtype=np.int32)[None, :]
        bits = random_bits(seed, episode[:, None], step[:, None], robots)
        applied = np.where(randomised, random_available(bits, available), applied)
    return applied.astype(np.int32, copy=False)
