"""From action values to actions; unavailable actions are never chosen."""

from __future__ import annotations

import numpy as np

from sim_pkg.contract import BoolArray, FloatArray, IntArray


def greedy(q: FloatArray, available: BoolArray) -> IntArray:
    """(..., A) values and availability -> (...) the best available action, the first of equals."""
    masked = np.where(available, q, np.float32(-np.inf))
    best: IntArray = masked.argmax(axis=-1).astype(np.int32)
    return best


def least_valued(q: FloatArray, available: BoolArray) -> IntArray:
    """As ``greedy``, (...) the worst available action, the first of equals."""
    masked = np.where(available, q, np.float32(np.inf))
    worst: IntArray = masked.argmin(axis=-1).astype(np.int32)
    return worst


def worst(q: FloatArray, available: BoolArray) -> IntArray:
    """(..., A) values and availability -> (...) the least valued available action, the first of
    equals: what an adversarial fault executes."""
    masked = np.where(available, q, np.float32(np.inf))
    least: IntArray = masked.argmin(axis=-1).astype(np.int32)
    return least


def epsilon_greedy(
    q: FloatArray, available: BoolArray, epsilon: float, rng: np.random.Generator
) -> IntArray:
    """Each row on its own: with probability ``epsilon`` a uniform available action, else greedy.

    q, available: (..., A). Takes the same number of draws from ``rng`` whatever the values are.
    """
    draws = rng.random((2, *q.shape[:-1]))
    best = greedy(q, available)
    order = np.cumsum(available, axis=-1)
    pick = (draws[1] * order[..., -1]).astype(np.int64)
    uniform = np.argmax(order > pick[..., None], axis=-1)
    return np.where(draws[0] < epsilon, uniform, best).astype(np.int32)
