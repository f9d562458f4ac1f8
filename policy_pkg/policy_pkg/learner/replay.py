"""Ring of whole episodes, sampled by a compiled gather into a packed batch.

Packed means: the sampled episodes are sorted by length, longest first, and laid out time-major.
At time t only the first ``alive[t]`` episodes still have an observation, so no row is padding::

    t:        0        1        2     3
    rows:  e0 e1 e2 e0 e1 e2 e0 e1  e0        lengths T = 3, 2, 1

Episodes are drawn uniformly, or half of the probability is spread evenly over strata: by which
robots were faulted, and, for outcome, by success. What is rare is then not forgotten.

Step t of episode i exists where t < T_i, which is exactly where observation t+1 exists. So the
M valid steps, in the same order, are the observation rows from ``alive[0]`` on, moved back by one.
"""

from __future__ import annotations

import mmap
from dataclasses import dataclass, fields, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.quick_numba import njit
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.memory import room
from policy_pkg.learner.strata import Strata

Array = npt.NDArray[Any]
_EVEN_SHARE = 0.5  # of the sampling probability, spread evenly over the strata


@dataclass(frozen=True)
class Batch:
    """B episodes, packed: N observation rows, M = N - B valid steps (see the module's text).

    The arrays are buffers of the replay, valid until its next ``sample``; ``copy`` keeps them.
    """

    inputs: npt.NDArray[np.float32]  # (N, n, O+A+n): observation, last action, robot one-hots
    state: npt.NDArray[np.float32]  # (N, S)
    now: npt.NDArray[np.int64]  # (M,) the observation row at which each step begins
    actions: npt.NDArray[np.int64]  # (M, n)
    reward: npt.NDArray[np.float32]  # (M,)
    bootstrap: npt.NDArray[np.float32]  # (M,) 0 where the step terminated its episode, else 1
    available: npt.NDArray[np.bool_]  # (N, n, A)
    faults: npt.NDArray[np.uint8]  # (M, n)
    alive: npt.NDArray[np.int64]  # (L+1,) episodes that have an observation at t
    slots: npt.NDArray[np.int64]  # (B,) which stored episodes, longest first

    @property
    def available_next(self) -> npt.NDArray[np.bool_]:
        """(M, n, A) available at each step's end."""
        return self.available[int(self.alive[0]) :]

    @property
    def episode(self) -> npt.NDArray[np.int64]:
        """(M,) which of the batch's episodes each step belongs to."""
        counts = self.alive[1:]
        starts = np.repeat(np.cumsum(counts) - counts, counts)
        return np.arange(len(self.now)) - starts

    def copy(self) -> Batch:
        return replace(self, **{name: array.copy() for name, array in self.arrays().items()})

    def arrays(self) -> dict[str, Array]:
        """Every array by name, for saving a batch for inspection."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


class Replay:
    """The newest ``capacity`` episodes. Memory is committed by the system as it is written.

    strata: what ``sample`` draws evenly over, besides uniformly: nothing; which robots were
        faulted (crashed); that and success (outcome).
    """

    def __init__(self, capacity: int, sizes: Sizes, strata: Strata = "none") -> None:
        if capacity < 1:
            raise ValueError(f"replay capacity is {capacity}; must be at least 1")
        self.sizes, self.capacity, self.strata = sizes, capacity, strata
        steps, n = sizes.episode_limit, sizes.n_robots
        self._store: dict[str, Array] = {
            "obs": _lazy((capacity, steps + 1, n, sizes.obs_size), np.float32),
            "state": _lazy((capacity, steps + 1, sizes.state_size), np.float32),
            "available": _lazy((capacity, steps + 1, n, sizes.n_actions), np.bool_),
            "actions": _lazy((capacity, steps, n), np.int32),
            "reward": _lazy((capacity, steps), np.float32),
            "faults": _lazy((capacity, steps, n), np.uint8),
        }
        self._length = np.zeros(capacity, np.int64)
        self._terminated = np.zeros(capacity, np.bool_)
        self._success = np.zeros(capacity, np.bool_)
        self._crashed = np.zeros((capacity, n), np.bool_)  # as in ``faults``
        self._added = 0
        self._chances: npt.NDArray[np.float64] | None = None  # until the content changes
        self._buffers: dict[str, Array] = {}

    def __len__(self) -> int:
        return min(self._added, self.capacity)

    @property
    def nbytes(self) -> int:
        """Bytes of the stored episodes' data."""
        steps = int(self._length.sum())
        return sum(
            (steps + len(self) * (store.shape[1] > self.sizes.episode_limit))
            * prod(store.shape[2:])
            * store.itemsize
            for store in self._store.values()
        )

    @property
    def nbytes_bound(self) -> int:
        """Bytes that the ring can ever take: ``capacity`` episodes of full length."""
        whole = sum(store.nbytes for store in self._store.values())
        flags = self._terminated.nbytes + self._success.nbytes + self._crashed.nbytes
        return whole + self._length.nbytes + flags

    def add(self, episode: Episode, success: bool = False) -> None:
        """Copies an episode in, over the oldest one when full. ``success``: for strata by outcome.

        Raises:
            ValueError: an array of a wrong shape or dtype, or an unknown action.
        """
        episode.check(self.sizes)
        slot = self._added % self.capacity
        for name, store in self._store.items():
            source = getattr(episode, name)
            store[slot, : source.shape[0]] = source
        self._length[slot] = episode.length
        self._terminated[slot] = episode.terminated
        self._success[slot] = success
        self._crashed[slot] = (episode.faults != 0).any(axis=0)
        self._added += 1
        self._chances = None

    def sample(self, rng: np.random.Generator, batch: int) -> Batch:
        """``batch`` different episodes: without strata each set equally likely, with strata drawn
        one after another with ``probabilities``.

        Raises:
            ValueError: fewer episodes are stored.
        """
        if not 1 <= batch <= len(self):
            raise ValueError(f"batch of {batch} episodes asked of a replay that holds {len(self)}")
        chances = None if self.strata == "none" else self.probabilities()
        return self.gather(
            rng.choice(len(self), size=batch, replace=False, shuffle=False, p=chances)
        )

    def probabilities(self) -> npt.NDArray[np.float64]:
        """(len,) of each stored episode to be the first one drawn; sum 1.

        Half of it is uniform, half is spread evenly over the strata that exist and within each
        uniform. Without strata all of it is uniform.
        """
        if self._chances is None:
            self._chances = self._probabilities()
        return self._chances

    def _probabilities(self) -> npt.NDArray[np.float64]:
        count = len(self)
        uniform = np.full(count, 1.0 / count)
        if self.strata == "none":
            return uniform
        keys = self._crashed[:count]
        if self.strata == "outcome":
            keys = np.concatenate((keys, self._success[:count, np.newaxis]), axis=1)
        packed = np.packbits(keys, axis=1)
        _, stratum, sizes = np.unique(packed, axis=0, return_inverse=True, return_counts=True)
        even = 1.0 / (len(sizes) * sizes[stratum.reshape(-1)])
        chances: npt.NDArray[np.float64] = (1 - _EVEN_SHARE) * uniform + _EVEN_SHARE * even
        return chances

    def importance(self, batch: Batch) -> npt.NDArray[np.float64]:
        """(B,) of a batch's episodes 1 / (N p), at most 2: what makes a stratified draw's expected
        loss that of a uniform draw (one after another without replacement: nearly)."""
        return 1.0 / (len(self) * self.probabilities()[batch.slots])

    def gather(self, slots: npt.NDArray[np.int64]) -> Batch:
        """The packed batch of the given stored episodes (0 <= slot < len); one may come twice."""
        lengths = self._length[slots]
        order = np.argsort(-lengths, kind="stable")
        slots, lengths = slots[order], lengths[order]
        # alive[t] = how many of the (descending) lengths are >= t
        alive = np.searchsorted(-lengths, -np.arange(lengths[0] + 1), side="right")
        out = self._batch(int(alive.sum()), slots, alive)
        store = self._store
        _gather(
            *(store["obs"], store["state"], store["available"], store["actions"]),
            *(store["reward"], store["faults"], self._terminated, self._length, slots, alive),
            *(out.inputs, out.state, out.now, out.actions, out.reward, out.bootstrap),
            *(out.available, out.faults),
        )
        return out

    def _batch(self, rows: int, slots: Array, alive: Array) -> Batch:
        sizes = self.sizes
        steps, n = rows - len(slots), sizes.n_robots
        return Batch(
            inputs=self._buffer("inputs", np.float32, (rows, n, sizes.input_size)),
            state=self._buffer("state", np.float32, (rows, sizes.state_size)),
            now=self._buffer("now", np.int64, (steps,)),
            actions=self._buffer("actions", np.int64, (steps, n)),
            reward=self._buffer("reward", np.float32, (steps,)),
            bootstrap=self._buffer("bootstrap", np.float32, (steps,)),
            available=self._buffer("available", np.bool_, (rows, n, sizes.n_actions)),
            faults=self._buffer("faults", np.uint8, (steps, n)),
            alive=alive,
            slots=slots,
        )

    def _buffer(self, name: str, dtype: npt.DTypeLike, shape: tuple[int, ...]) -> Array:
        """A view of a buffer that is kept between calls."""
        needed = prod(shape) * np.dtype(dtype).itemsize
        kept = self._buffers.get(name)
        if kept is None or kept.nbytes < needed:
            kept = self._buffers[name] = room(needed)
        return kept[:needed].view(dtype).reshape(shape)

    def state_dict(self) -> dict[str, Array]:
        """Everything as flat arrays that hold the filled part only; episodes one after another."""
        count = len(self)
        arrays: dict[str, Array] = {
            "added": np.array([self._added], np.int64),
            "length": self._length[:count].copy(),
            "terminated": self._terminated[:count].copy(),
            "success": self._success[:count].copy(),
        }
        for name, store in self._store.items():
            ends = self._length[:count] + (store.shape[1] - self.sizes.episode_limit)
            parts = [store[slot, :end] for slot, end in enumerate(ends)]
            arrays[name] = np.concatenate(parts) if parts else store[0, :0].copy()
        return arrays

    def load_state_dict(self, arrays: dict[str, Array]) -> None:
        """Puts back what ``state_dict`` gave, slot by slot.

        Raises:
            ValueError: the arrays belong to a replay of other sizes, or an array is missing.
        """
        missing = sorted({"added", "length", "terminated", "success", *self._store} - set(arrays))
        if missing:
            raise ValueError(f"replay state lacks {', '.join(missing)}")
        added, lengths = int(arrays["added"][0]), arrays["length"]
        count = min(added, self.capacity)
        if len(lengths) != count:
            raise ValueError(
                f"replay state holds {len(lengths)} of {added} episodes; "
                f"does not fit a capacity of {self.capacity}"
            )
        if count and not 1 <= lengths.min() <= lengths.max() <= self.sizes.episode_limit:
            raise ValueError(f"replay state has lengths outside 1..{self.sizes.episode_limit}")
        for name, store in self._store.items():
            ends = lengths + (store.shape[1] - self.sizes.episode_limit)
            expected = (int(ends.sum()), *store.shape[2:])
            if arrays[name].shape != expected or arrays[name].dtype != store.dtype:
                raise ValueError(
                    f"replay state {name} is {arrays[name].dtype} {arrays[name].shape}; "
                    f"must be {store.dtype} {expected}"
                )
        for name, store in self._store.items():
            ends = lengths + (store.shape[1] - self.sizes.episode_limit)
            for slot, part in enumerate(np.split(arrays[name], np.cumsum(ends)[:-1])):
                store[slot, : len(part)] = part
        self._length[:] = 0
        self._length[:count] = lengths
        self._terminated[:count] = arrays["terminated"]
        self._success[:count] = arrays["success"]
        faults = self._store["faults"]
        for slot, length in enumerate(lengths):
            self._crashed[slot] = (faults[slot, :length] != 0).any(axis=0)
        self._added, self._chances = added, None


def _lazy(shape: tuple[int, ...], dtype: npt.DTypeLike) -> Array:
    """Zeroed memory whose small pages are committed when first written, by the episode."""
    size = max(1, prod(shape) * np.dtype(dtype).itemsize)
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):  # Linux; a huge page would span unused steps
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype, count=prod(shape)).reshape(shape)


@njit(cache=True)
def _gather(
    obs: Array,
    state: Array,
    available: Array,
    actions: Array,
    reward: Array,
    faults: Array,
    terminated: Array,
    length: Array,
    slots: Array,
    alive: Array,
    out_inputs: Array,
    out_state: Array,
    out_now: Array,
    out_actions: Array,
    out_reward: Array,
    out_bootstrap: Array,
    out_available: Array,
    out_faults: Array,
) -> None:
    """Copies the stored rows to their packed places; steps get the index of their first row."""
    n, obs_size = obs.shape[2], obs.shape[3]
    n_actions = available.shape[3]
    row, step, before = 0, 0, 0
    for t in range(alive.shape[0]):
        for i in range(alive[t]):
            slot = slots[i]
            out_state[row] = state[slot, t]
            out_inputs[row, :, :obs_size] = obs[slot, t]
            out_inputs[row, :, obs_size:] = 0.0
            out_available[row] = available[slot, t]
            for robot in range(n):
                out_inputs[row, robot, obs_size + n_actions + robot] = 1.0
                if t > 0:
                    out_inputs[row, robot, obs_size + actions[slot, t - 1, robot]] = 1.0
            if t > 0:
                out_now[step] = before + i
                out_reward[step] = reward[slot, t - 1]
                ended = terminated[slot] and t == length[slot]
                out_bootstrap[step] = 0.0 if ended else 1.0
                for robot in range(n):
                    out_actions[step, robot] = actions[slot, t - 1, robot]
                    out_faults[step, robot] = faults[slot, t - 1, robot]
                step += 1
            row += 1
        if t > 0:
            before += alive[t - 1]
