"""Who crashes: the cap on crashed robots and draws below it.

Source: the paper's re-sampling (discard masks with too many crashed agents), drawn here in
bounded time: k from Binomial(n, alpha) truncated at the cap, then k robots uniformly, which is
the same law as rejection.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from crash_coach_common.contract import BoolArray

CapRule = Literal["ceil", "floor", "authors"]
_STREAM = 0xC0AC4  # keeps crash draws apart from the environment's stream of the same seed


def episode_rng(seed: int, episode: int, stream: int = 0) -> np.random.Generator:
    """The generator of one episode's crash draws, a function of (seed, episode, stream) alone."""
    key = np.array([seed ^ _STREAM, episode], dtype=np.uint64)
    # The counter's highest word: streams that no draw can run into.
    counter = np.array([0, 0, 0, stream], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def crash_cap(rule: CapRule, n: int, rate: float, limit: int, resample: bool) -> int:
    """Most robots of n that may crash together at ``rate``.

    ``limit`` holds always, ``rule`` only with ``resample``.
    """
    cap = min(n, limit)
    if resample:
        cap = min(cap, _rule_cap(rule, n, rate))
    return max(0, cap)


def _rule_cap(rule: CapRule, n: int, rate: float) -> int:
    match rule:
        case "ceil":
            return math.ceil(n * rate - 1e-9)
        case "floor":
            return math.floor(n * rate)
        case "authors":
            return n - round(n * (1 - rate))  # Python rounds half to even, as the authors' numpy


def draw_mask(rng: np.random.Generator, n: int, rate: float, cap: int) -> BoolArray:
    """(n,) crashed; k <= cap of the truncated binomial law, then k uniform robots."""
    return draw_exactly(rng, n, _draw_count(rng, n, rate, min(cap, n)))


def draw_exactly(rng: np.random.Generator, n: int, count: int) -> BoolArray:
    """(n,) mask with ``count`` uniformly chosen robots."""
    mask = np.zeros(n, dtype=np.bool_)
    mask[rng.permutation(n)[:count]] = True
    return mask


def _draw_count(rng: np.random.Generator, n: int, rate: float, cap: int) -> int:
    # Divided by (1 - rate)^(n - cap), so that the law stays defined up to rate 1.
    weights = [math.comb(n, k) * rate**k * (1 - rate) ** (cap - k) for k in range(cap + 1)]
    cumulative = np.cumsum(weights)
    u = rng.random() * cumulative[-1]
    return min(cap, int(np.searchsorted(cumulative, u, side="right")))
