"""Random bits keyed by counters: neither the order of arrival nor batching can change them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

UInt64Array = npt.NDArray[np.uint64]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_BITS = 2**64 - 1


def _splitmix64(x: UInt64Array) -> UInt64Array:
    """The finaliser of SplitMix64 (Steele, Lea, Flood 2014), element by element."""
    x = x + _GOLDEN
    x = (x ^ (x >> np.uint64(30))) * _MIX_1
    x = (x ^ (x >> np.uint64(27))) * _MIX_2
    return x ^ (x >> np.uint64(31))


def random_bits(
    seed: npt.ArrayLike,
    episode: npt.ArrayLike,
    step: npt.ArrayLike,
    robot: npt.ArrayLike,
    stream: int = 0,
) -> UInt64Array:
    """64 uniform bits for each (seed, episode, step, robot); they broadcast, at least 1-d.

    ``stream`` keeps different uses of one key apart; 0 is the random actions'.
    """
    key = _splitmix64(np.atleast_1d(np.asarray(seed, dtype=np.uint64)))
    for counter in (episode, step, robot):
        key = _splitmix64(key ^ np.asarray(counter).astype(np.uint64))
    return _splitmix64(key ^ np.uint64(stream)) if stream else key


def _splitmix64_of_one(x: int) -> int:
    x = (x + int(_GOLDEN)) & _BITS
    x = ((x ^ (x >> 30)) * int(_MIX_1)) & _BITS
    x = ((x ^ (x >> 27)) * int(_MIX_2)) & _BITS
    return x ^ (x >> 31)


def bits_of_one(seed: int, episode: int, step: int, robot: int, stream: int = 0) -> int:
    """As ``random_bits``, of one key, as a gate asks: numpy takes five times as long for it."""
    key = _splitmix64_of_one(int(np.uint64(seed)))
    for counter in (episode, step, robot):
        key = _splitmix64_of_one(key ^ (int(counter) & _BITS))
    return _splitmix64_of_one(key ^ stream) if stream else key
