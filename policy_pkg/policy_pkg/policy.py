"""The agent network's forward pass: the one path that acts, in rollouts and on robots.

Linear - ReLU - GRU - Linear, shared by all robots, as PyMARL's ``RNNAgent``. Where set-up built
kernels, one step is compiled (``native``), because each of numpy's some thirty calls costs several
microseconds in a process that others have driven out of the caches; it has the bits of what
stands here where numpy uses OpenBLAS' kernels for Haswell. BLAS is handed eight
rows at a time: how it sums depends on the number of rows and, with some of its kernels (Haswell's
and Zen's), on a row's place among them, but not within eight. So a row's result does not depend,
bit for bit, on how many rows are computed with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import FloatArray, IntArray
from policy_pkg.native.acting import CompiledStep, compiled

BLOCK_ROWS = 8
WeightArrays = dict[str, npt.NDArray[np.float32]]

WEIGHT_NAMES = (
    "fc1.weight",
    "fc1.bias",
    "rnn.weight_ih",
    "rnn.weight_hh",
    "rnn.bias_ih",
    "rnn.bias_hh",
    "fc2.weight",
    "fc2.bias",
)


@dataclass(frozen=True)
class PolicySizes:
    """Sizes that a set of weights was made for."""

    obs: int
    actions: int
    robots: int
    hidden: int


def weight_shapes(inputs: int, hidden: int, actions: int) -> dict[str, tuple[int, ...]]:
    """Shape of each weight; ``inputs`` is observation + actions + robots."""
    return {
        "fc1.weight": (hidden, inputs),
        "fc1.bias": (hidden,),
        "rnn.weight_ih": (3 * hidden, hidden),
        "rnn.weight_hh": (3 * hidden, hidden),
        "rnn.bias_ih": (3 * hidden,),
        "rnn.bias_hh": (3 * hidden,),
        "fc2.weight": (actions, hidden),
        "fc2.bias": (actions,),
    }


def check_weights(
    weights: dict[str, npt.NDArray[np.float32]], n_robots: int, n_actions: int
) -> PolicySizes:
    """Raises ValueError naming the first weight that is missing, misshapen or not finite."""
    missing = sorted(set(WEIGHT_NAMES) - set(weights))
    unknown = sorted(set(weights) - set(WEIGHT_NAMES))
    if missing or unknown:
        raise ValueError(f"agent weights: missing {missing}, unknown {unknown}")
    first = weights["fc1.weight"]
    if first.ndim != 2 or first.shape[1] <= n_actions + n_robots:
        raise ValueError(
            f"fc1.weight has shape {first.shape}; expected (hidden, observation + {n_actions} "
            f"actions + {n_robots} robots)"
        )
    hidden, inputs = first.shape
    for name, shape in weight_shapes(inputs, hidden, n_actions).items():
        if weights[name].shape != shape:
            raise ValueError(f"{name} has shape {weights[name].shape}, expected {shape}")
        if not np.isfinite(weights[name]).all():
            raise ValueError(f"{name} holds values that are not finite")
    return PolicySizes(inputs - n_actions - n_robots, n_actions, n_robots, hidden)


@dataclass
class _Buffers:
    """Scratch memory for one padded number of rows."""

    obs: FloatArray
    hidden: FloatArray
    encoded: FloatArray
    gates_in: FloatArray
    gates_hidden: FloatArray
    q: FloatArray


class RecurrentPolicy:
    """Action values from observations; the caller keeps the hidden state.

    Args:
        weights: float32, torch's layout of nn.Linear and nn.GRUCell (gates r, z, n); names in
            WEIGHT_NAMES. The input of ``fc1`` is observation, last action one-hot, robot one-hot.
        n_robots: length of the robot one-hot.
        n_actions: length of the last action's one-hot, and of the output.

    Raises:
        ValueError: a weight is missing, misshapen or not finite.
    """

    def __init__(
        self, weights: dict[str, npt.NDArray[np.float32]], n_robots: int, n_actions: int
    ) -> None:
        self.sizes = check_weights(weights, n_robots, n_actions)
        self._buffers: dict[int, _Buffers] = {}
        self._compiled: CompiledStep | None = None
        self._assign(weights)

    def set_weights(self, weights: dict[str, npt.NDArray[np.float32]]) -> None:
        """Takes a copy of newer weights of the same sizes.

        Raises:
            ValueError: other sizes, or a value that is not finite.
        """
        sizes = check_weights(weights, self.sizes.robots, self.sizes.actions)
        if sizes != self.sizes:
            raise ValueError(f"weights of sizes {sizes}, this policy has {self.sizes}")
        self._assign(weights)

    def _assign(self, weights: WeightArrays) -> None:
        self._weights = {name: np.array(weights[name], dtype=np.float32) for name in WEIGHT_NAMES}
        if self._compiled is not None:
            self._compiled.set_weights(self._weights)
            return
        self._compiled = compiled(self._weights, self.sizes.robots, self.sizes.actions)
        if self._compiled is None:
            self._lay_out(self._weights)

    def _lay_out(self, weights: WeightArrays) -> None:
        """As numpy wants them."""
        obs, actions = self.sizes.obs, self.sizes.actions
        first = np.asarray(weights["fc1.weight"], dtype=np.float32)
        self._w_obs = np.array(first[:, :obs].T, order="C")
        # A one-hot times a matrix is a row of it. The last row serves action -1, "none yet".
        none = np.zeros((1, self.sizes.hidden), dtype=np.float32)
        self._action_rows = np.concatenate([first[:, obs : obs + actions].T, none])
        self._robot_rows = first[:, obs + actions :].T + weights["fc1.bias"]
        self._w_ih = np.array(weights["rnn.weight_ih"].T, dtype=np.float32, order="C")
        self._w_hh = np.array(weights["rnn.weight_hh"].T, dtype=np.float32, order="C")
        self._b_ih = np.array(weights["rnn.bias_ih"], dtype=np.float32)
        self._b_hh = np.array(weights["rnn.bias_hh"], dtype=np.float32)
        self._w_out = np.array(weights["fc2.weight"].T, dtype=np.float32, order="C")
        self._b_out = np.array(weights["fc2.bias"], dtype=np.float32)

    def __reduce__(self) -> tuple[type[RecurrentPolicy], tuple[WeightArrays, int, int]]:
        """Goes to another process, which has a build or none, as its weights."""
        return RecurrentPolicy, (self._weights, self.sizes.robots, self.sizes.actions)

    def initial_hidden(self, rows: int) -> FloatArray:
        """(rows, H) zeros: the hidden state at the start of an episode."""
        return np.zeros((rows, self.sizes.hidden), dtype=np.float32)

    def forward(
        self, obs: FloatArray, last_action: IntArray, robot: IntArray, hidden: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """One step of R rows.

        Args:
            obs: (R, O) float32.
            last_action: (R,) int32, the last executed action, -1 at an episode's first step.
            robot: (R,) int32 index of the robot that each row belongs to.
            hidden: (R, H) float32.

        Returns:
            q (R, A) and the next hidden state (R, H), new arrays.

        Raises:
            ValueError: shapes that do not fit together.
        """
        rows = len(obs)
        self._check(obs, last_action, robot, hidden)
        if self._compiled is not None:
            return self._compiled.forward(obs, last_action, robot, hidden)
        buf = self._scratch(rows)
        buf.obs[:rows] = obs
        buf.hidden[:rows] = hidden
        x = _product(buf.obs, self._w_obs, buf.encoded)
        x[:rows] += self._action_rows[last_action]
        x[:rows] += self._robot_rows[robot]
        np.maximum(x, 0.0, out=x)
        h_next = self._gru(x, buf)
        q = _product(h_next, self._w_out, buf.q)
        q += self._b_out
        return q[:rows].copy(), h_next[:rows].copy()

    def _gru(self, x: FloatArray, buf: _Buffers) -> FloatArray:
        """torch.nn.GRUCell: r, z = sigmoid(..), n = tanh(W x + r (U h)), h' = n + z (h - n)."""
        h = self.sizes.hidden
        gates = _product(x, self._w_ih, buf.gates_in)
        gates += self._b_ih
        recurrent = _product(buf.hidden, self._w_hh, buf.gates_hidden)
        recurrent += self._b_hh
        reset_update = gates[:, : 2 * h]
        reset_update += recurrent[:, : 2 * h]
        # sigmoid(v) = (1 + tanh(v / 2)) / 2 cannot overflow.
        reset_update *= 0.5
        np.tanh(reset_update, out=reset_update)
        reset_update += 1.0
        reset_update *= 0.5
        candidate = gates[:, 2 * h :]
        recurrent_n = recurrent[:, 2 * h :]
        recurrent_n *= reset_update[:, :h]
        candidate += recurrent_n
        np.tanh(candidate, out=candidate)
        buf.hidden -= candidate
        buf.hidden *= reset_update[:, h:]
        buf.hidden += candidate
        return buf.hidden

    def _scratch(self, rows: int) -> _Buffers:
        padded = -(-rows // BLOCK_ROWS) * BLOCK_ROWS
        if padded not in self._buffers:
            h = self.sizes.hidden
            widths = (self.sizes.obs, h, h, 3 * h, 3 * h, self.sizes.actions)
            self._buffers[padded] = _Buffers(
                *(np.zeros((padded, width), dtype=np.float32) for width in widths)
            )
        buf = self._buffers[padded]
        buf.obs[rows:] = 0.0
        buf.hidden[rows:] = 0.0
        return buf

    def _check(
        self, obs: FloatArray, last_action: IntArray, robot: IntArray, hidden: FloatArray
    ) -> None:
        rows = len(obs)
        shapes = (obs.shape, last_action.shape, robot.shape, hidden.shape)
        expected = ((rows, self.sizes.obs), (rows,), (rows,), (rows, self.sizes.hidden))
        if shapes != expected:
            raise ValueError(
                f"obs, last_action, robot, hidden have shapes {shapes}, expected {expected}"
            )


def _product(rows: FloatArray, weight: FloatArray, out: FloatArray) -> FloatArray:
    """out = rows @ weight, in blocks of BLOCK_ROWS, of which ``rows`` has a whole number."""
    blocks = rows.reshape(-1, BLOCK_ROWS, rows.shape[1])
    np.matmul(blocks, weight, out=out.reshape(len(blocks), BLOCK_ROWS, -1))
    return out
