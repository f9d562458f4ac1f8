"""What a policy node chooses with: as the arrays' functions, also of equals and of nothing."""

from __future__ import annotations

import numpy as np

from policy_pkg.act import best_and_worst, greedy, least_valued


def test_best_and_worst_are_greedy_and_least_valued() -> None:
    rng = np.random.default_rng(0)
    for actions in (1, 2, 5, 14):
        # few values, so that many are equal
        q = rng.integers(-2, 3, (500, actions)).astype(np.float32)
        available = rng.random((500, actions)) < 0.5
        available[np.arange(500), rng.integers(actions, size=500)] = True
        expected = zip(greedy(q, available), least_valued(q, available), strict=True)
        assert best_and_worst(q, available) == [(best, worst) for best, worst in expected]


def test_where_nothing_is_available_there_is_no_choice() -> None:
    q = np.zeros((2, 3), dtype=np.float32)
    available = np.array([[False] * 3, [False, True, False]])
    assert best_and_worst(q, available) == [(-1, -1), (1, 1)]
