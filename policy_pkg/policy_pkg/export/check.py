"""An exported model against the numpy policy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from crash_coach_common.contract import FloatArray, IntArray
from policy_pkg.policy import RecurrentPolicy

STEPS = 1000
SEED = 7
# (observation, last_action, robot, hidden) -> (q, next_hidden), as RecurrentPolicy.forward
Step = Callable[[FloatArray, IntArray, IntArray, FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Difference:
    """The largest of any action value, and of any hidden state.

    Divided by the largest value of its step where that is more than 1: float32 has seven digits.
    """

    values: float = 0.0
    hidden: float = 0.0

    @property
    def largest(self) -> float:
        return max(self.values, self.hidden)


def compare(
    policy: RecurrentPolicy, model: Step, steps: int = STEPS, own_memory: bool = False
) -> Difference:
    """Of a team of all robots that plays ``steps`` steps.

    Observations are uniform in [-1, 1], last actions any or none.

    own_memory: the model goes on from its own hidden state, not from the numpy policy's, so that
        rounding may build up; how much, depends on the weights.
    """
    rng = np.random.default_rng(SEED)
    robots, worst = policy.sizes.robots, Difference()
    robot = np.arange(robots, dtype=np.int32)
    mine = theirs = policy.initial_hidden(robots)
    for _ in range(steps):
        seen = rng.uniform(-1, 1, (robots, policy.sizes.obs)).astype(np.float32)
        last = rng.integers(-1, policy.sizes.actions, robots, dtype=np.int32)
        their_q, theirs = model(seen, last, robot, theirs if own_memory else mine)
        q, mine = policy.forward(seen, last, robot, mine)
        worst = Difference(
            max(worst.values, _difference(their_q, q)), max(worst.hidden, _difference(theirs, mine))
        )
    return worst


def _difference(got: FloatArray, expected: FloatArray) -> float:
    return float(np.abs(got - expected).max()) / max(1.0, float(np.abs(expected).max()))
