"""SHA-256 of an episode's trajectory: equal hashes mean equal bits, step by step."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable

from crash_coach_common.contract import FloatArray, IntArray


class TrajectoryHash:
    """Rolling hash of one episode; the same calls give the same digest on every machine."""

    def __init__(self, seed: int, episode: int) -> None:
        self._sha = hashlib.sha256(struct.pack("<Qq", seed, episode))

    def observe(self, obs: FloatArray, state: FloatArray) -> None:
        """Adds what is seen before a step. obs: (n, O) float32; state: (S,) float32."""
        self._sha.update(obs.tobytes())
        self._sha.update(state.tobytes())

    def act(
        self, actions: IntArray, reward: float, terminated: bool, truncated: bool, success: bool
    ) -> None:
        """Adds the executed actions, (n,) int32, and the step's outcome."""
        self._sha.update(actions.tobytes())
        self._sha.update(struct.pack("<d???", reward, terminated, truncated, success))

    def hexdigest(self) -> str:
        return self._sha.hexdigest()


class CourseHash:
    """Rolling hash of what happened in an episode, whatever its seed and number: equal for two
    episodes that went alike. Of what the ROS graph publishes, so that both sides can tell it.
    """

    def __init__(self) -> None:
        self._sha = hashlib.sha256()

    def observe(self, state: FloatArray) -> None:
        """Adds the global state before a step. state: (S,) float32."""
        self._sha.update(state.tobytes())

    def act(self, actions: IntArray, reward: float) -> None:
        """Adds the executed actions, (n,) int32, and the reward."""
        self._sha.update(actions.tobytes())
        self._sha.update(struct.pack("<d", reward))

    def finish(self, success: bool) -> str:
        """Adds how it ended; the hash in hexadecimal digits."""
        self._sha.update(struct.pack("<?", success))
        return self._sha.hexdigest()


def combine(digests: Iterable[str]) -> str:
    """One hash for many episodes, in the order given."""
    sha = hashlib.sha256()
    for digest in digests:
        sha.update(bytes.fromhex(digest))
    return sha.hexdigest()
