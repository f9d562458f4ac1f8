"""The compiled step of the agent net: what policy.RecurrentPolicy acts with where it is built."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import FloatArray, IntArray
from policy_pkg import native

Weights = Mapping[str, npt.NDArray[np.float32]]
_POINTER = ctypes.c_void_p


@dataclass(frozen=True, slots=True)
class _Rows:
    """What a step of some rows reads and writes. ``address``: of its C struct."""

    obs: FloatArray
    last_action: IntArray
    robot: IntArray
    hidden: FloatArray
    reset_update: FloatArray
    candidate: FloatArray
    q: FloatArray
    address: int


class _Memory:
    """For up to ``rows`` rows. h, a: ``hidden`` and ``actions`` as the kernels pad them."""

    def __init__(self, rows: int, obs: int, actions: int, hidden: int, h: int, a: int) -> None:
        self.capacity = rows
        self._hidden, self._actions = hidden, actions
        widths = (h, h, 3 * h, 3 * h, 2 * h, h, a)
        self._floats = [np.zeros((rows, width), dtype=np.float32) for width in (obs, *widths)]
        self._indices = [np.zeros(rows, dtype=np.int32) for _ in range(2)]
        order = (self._floats[0], *self._indices, *self._floats[1:])
        self._addresses = (_POINTER * len(order))(*(array.ctypes.data for array in order))
        self._views: dict[int, _Rows] = {}

    def first(self, rows: int) -> _Rows:
        if rows not in self._views:
            obs, state, _, _, _, reset_update, candidate, values = (x[:rows] for x in self._floats)
            last_action, robot = (x[:rows] for x in self._indices)
            hidden, q = state[:, : self._hidden], values[:, : self._actions]
            self._views[rows] = _Rows(
                *(obs, last_action, robot, hidden, reset_update, candidate, q),
                ctypes.addressof(self._addresses),
            )
        return self._views[rows]


class CompiledStep:
    """As policy.RecurrentPolicy.forward, for a net that is one of ``compiled``."""

    def __init__(self, kernels: ctypes.CDLL, net: int, obs: int, actions: int, hidden: int) -> None:
        h, a = ctypes.c_int(), ctypes.c_int()
        kernels.acting_widths(net, ctypes.byref(h), ctypes.byref(a))
        self._net, self._set = net, kernels.acting_set
        self._sizes = obs, actions, hidden, h.value, a.value
        weakref.finalize(self, kernels.acting_free, net)
        self._gates, self._candidate = kernels.acting_gates, kernels.acting_candidate
        self._values = kernels.acting_values
        self._memory = _Memory(1, *self._sizes)

    def set_weights(self, weights: Weights) -> None:
        """Takes a copy of others of the same sizes, as ``compiled`` does."""
        with _pointers(weights) as pointers:
            self._set(self._net, pointers)

    def forward(
        self, obs: FloatArray, last_action: IntArray, robot: IntArray, hidden: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Raises IndexError for a last action or a robot that does not exist."""
        rows = len(obs)
        if rows > self._memory.capacity:
            self._memory = _Memory(1 << (rows - 1).bit_length(), *self._sizes)
        x = self._memory.first(rows)
        x.obs[...] = obs
        x.last_action[...] = last_action
        x.robot[...] = robot
        x.hidden[...] = hidden
        bad = self._gates(self._net, rows, x.address)
        if bad >= 0:
            raise IndexError(
                f"row {bad}: no last action {last_action[bad]} of {self._sizes[1]}, or no robot "
                f"{robot[bad]}"
            )
        np.tanh(x.reset_update, x.reset_update)
        self._candidate(self._net, rows, x.address)
        np.tanh(x.candidate, x.candidate)
        self._values(self._net, rows, x.address)
        return x.q.copy(), x.hidden.copy()


def compiled(weights: Weights, n_robots: int, n_actions: int) -> CompiledStep | None:
    """For weights by the names of policy.WEIGHT_NAMES, in that order, of which it takes a copy.

    None: numpy has to do it, because there is no build or for sizes that it does not have.
    """
    kernels = native.library()
    if kernels is None:
        return None
    hidden, inputs = weights["fc1.weight"].shape
    obs = inputs - n_actions - n_robots
    with _pointers(weights) as pointers:
        net = kernels.acting_new(obs, n_actions, n_robots, hidden, pointers)
    return None if net is None else CompiledStep(kernels, net, obs, n_actions, hidden)


@contextmanager
def _pointers(weights: Weights) -> Iterator[object]:
    """To contiguous float32 arrays, while the block lasts."""
    arrays = [np.ascontiguousarray(array, dtype=np.float32) for array in weights.values()]
    yield (_POINTER * len(arrays))(*(array.ctypes.data for array in arrays))
