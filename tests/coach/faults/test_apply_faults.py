"""Applying faults to commands, and the keyed generator of random actions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_common.keyed_random import UInt64Array, bits_of_one, random_bits
from crash_coach_pkg.faults.batch_faults import (
    MUTE_CODE,
    RANDOM_CODE,
    apply_faults,
    random_available,
)


def _bits(seed: int, count: int) -> UInt64Array:
    episodes = np.arange(count, dtype=np.int64)
    return random_bits(seed, episodes, 3, 1)


@pytest.mark.parametrize("pattern", ["11111", "10101", "00101", "01011"])
def test_random_available_is_uniform_over_the_available(
    pattern: str, fits: Callable[..., bool]
) -> None:
    available = np.array([c == "1" for c in pattern])
    chosen = random_available(_bits(5, 20_000), np.broadcast_to(available, (20_000, 5)))
    counts = np.bincount(chosen, minlength=5)
    assert counts[~available].sum() == 0
    assert fits(counts[available], 20_000 / available.sum())


@pytest.mark.parametrize("axis", range(3))
def test_bits_of_neighbouring_keys_are_unrelated(axis: int) -> None:
    """Low bits and the bit-wise difference of keys that differ by one are fair coins."""
    keys: list[npt.ArrayLike] = [1, 2, 3]
    keys[axis] = np.arange(4096)
    bits = random_bits(0, *keys)
    assert len(np.unique(bits)) == 4096
    flips = np.unpackbits((bits[1:] ^ bits[:-1]).view(np.uint8)).mean()
    assert flips == pytest.approx(0.5, abs=0.01)


@given(
    st.integers(0, 2**64 - 1), st.tuples(*3 * [st.integers(-(2**63), 2**63 - 1)]), st.integers(0, 3)
)
def test_a_key_on_its_own_has_the_bits_it_has_among_others(
    seed: int, key: tuple[int, int, int], stream: int
) -> None:
    alone = bits_of_one(seed, *key, stream=stream)
    counters = [np.array([0, part]) for part in key]
    assert alone == random_bits(np.uint64(seed), *counters, stream=stream)[1]


def test_every_key_counts() -> None:
    base = random_bits(1, 2, 3, 4)
    others = [
        random_bits(9, 2, 3, 4),
        random_bits(1, 9, 3, 4),
        random_bits(1, 2, 9, 4),
        random_bits(1, 2, 3, 9),
        random_bits(1, 3, 2, 4),
        random_bits(1, 2, 3, 4, stream=9),
    ]
    assert len({int(b[0]) for b in (base, *others)}) == 7


@settings(max_examples=60)
@given(
    teams=st.integers(1, 6),
    robots=st.integers(1, 5),
    actions=st.integers(1, 7),
    seed=st.integers(0, 2**63 - 1),
    draw=st.integers(0, 2**32 - 1),
)
def test_effect_equals_mode_and_batching_does_not_matter(
    teams: int, robots: int, actions: int, seed: int, draw: int
) -> None:
    rng = np.random.default_rng(draw)
    shape = (teams, robots)
    available = rng.random((*shape, actions)) < 0.5
    available[np.arange(teams)[:, None], np.arange(robots), rng.integers(actions, size=shape)] = (
        True
    )
    pick = np.argmax(available, axis=-1).astype(np.int32)
    intent = random_available(rng.integers(2**64, size=shape, dtype=np.uint64), available)
    modes = rng.integers(0, 3, size=shape).astype(np.uint8)
    episode = rng.integers(0, 2**32, size=teams)
    step = rng.integers(0, 1000, size=teams)
    applied = apply_faults(intent, modes, available, pick, seed, episode, step)
    assert applied.dtype == np.int32
    assert np.array_equal(applied[modes == 0], intent[modes == 0])
    assert np.array_equal(applied[modes == MUTE_CODE], pick[modes == MUTE_CODE])
    assert np.take_along_axis(available, applied[..., None], axis=-1).all()
    for b in range(teams):
        row = slice(b, b + 1)
        alone = apply_faults(
            intent[row], modes[row], available[row], pick[row], seed, episode[row], step[row]
        )
        assert np.array_equal(alone[0], applied[b])


def test_intent_is_not_written_to() -> None:
    intent = np.array([[1, 1]], dtype=np.int32)
    modes = np.array([[RANDOM_CODE, MUTE_CODE]], dtype=np.uint8)
    available = np.array([[[True, False], [True, False]]])
    stay = np.zeros((1, 2), dtype=np.int32)
    keys = np.zeros(1, dtype=np.int64)
    assert apply_faults(intent, modes, available, stay, 0, keys, keys).tolist() == [[0, 0]]
    assert intent.tolist() == [[1, 1]]
