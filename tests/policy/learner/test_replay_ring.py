"""The replay: ring order, uniform samples, the packed layout, round trips, memory."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from reference_learner import random_episode

from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.replay import Replay

SIZES = Sizes(n_robots=2, n_actions=3, obs_size=4, state_size=5, episode_limit=6)


def _episodes(count: int, seed: int = 0) -> list[Episode]:
    rng = np.random.default_rng(seed)
    return [
        random_episode(SIZES, rng, int(rng.integers(1, 7)), bool(rng.integers(2)), 0.3)
        for _ in range(count)
    ]


def _filled(episodes: list[Episode], capacity: int) -> Replay:
    replay = Replay(capacity, SIZES)
    for episode in episodes:
        replay.add(episode)
    return replay


def test_packed_batch_holds_every_row_of_every_episode_once() -> None:
    """Walks the packed layout and compares each row with the episode that it came from."""
    episodes = _episodes(9)
    batch = _filled(episodes, 9).sample(np.random.default_rng(1), 7)
    chosen = [episodes[slot] for slot in batch.slots]
    lengths = [e.length for e in chosen]
    assert lengths == sorted(lengths, reverse=True)
    assert batch.alive.tolist() == [sum(x >= t for x in lengths) for t in range(lengths[0] + 1)]
    row_of, row = {}, 0
    for t, alive in enumerate(batch.alive):
        for i in range(alive):
            e = chosen[i]
            row_of[t, i] = row
            np.testing.assert_array_equal(batch.state[row], e.state[t])
            last = np.zeros((2, 3))
            if t > 0:
                last[[0, 1], e.actions[t - 1]] = 1
            expected = np.concatenate((e.obs[t], last.astype(np.float32), np.eye(2)), axis=1)
            np.testing.assert_array_equal(batch.inputs[row], expected)
            row += 1
    assert row == len(batch.state) == len(batch.inputs)
    steps = [(t, i) for t in range(lengths[0]) for i in range(batch.alive[t + 1])]
    assert len(batch.now) == len(steps) == sum(lengths)
    for step, (t, i) in enumerate(steps):
        e = chosen[i]
        assert batch.now[step] == row_of[t, i]
        assert batch.alive[0] + step == row_of[t + 1, i]
        assert batch.reward[step] == e.reward[t]
        assert batch.bootstrap[step] == float(not (e.terminated and t == e.length - 1))
        np.testing.assert_array_equal(batch.actions[step], e.actions[t])
        np.testing.assert_array_equal(batch.faults[step], e.faults[t])
        np.testing.assert_array_equal(batch.available_next[step], e.available[t + 1])


def test_ring_overwrites_the_oldest() -> None:
    episodes = _episodes(8)
    replay = _filled(episodes, 5)
    assert len(replay) == 5
    batch = replay.sample(np.random.default_rng(0), 5)
    in_slot = [*episodes[5:], *episodes[3:5]]
    assert sorted(batch.slots.tolist()) == [0, 1, 2, 3, 4]
    for i, slot in enumerate(batch.slots.tolist()):
        np.testing.assert_array_equal(batch.state[i], in_slot[slot].state[0])


def test_samples_are_uniform_and_without_replacement() -> None:
    replay, rng = _filled(_episodes(20), 20), np.random.default_rng(3)
    counts, pairs, draws = np.zeros(20), np.zeros((20, 20)), 4000
    for _ in range(draws):
        slots = replay.sample(rng, 5).slots
        assert len(set(slots.tolist())) == 5
        counts[slots] += 1
        pairs[np.ix_(slots, slots)] += 1
    expected = draws * 5 / 20
    # chi-square of 19 degrees of freedom (the draws' spread is below it): 0.999 quantile
    assert ((counts - expected) ** 2 / expected).sum() < 43.8
    off = pairs[~np.eye(20, dtype=bool)]
    assert np.abs(off / draws - 5 * 4 / (20 * 19)).max() < 0.02


def test_same_generator_same_batch() -> None:
    replay = _filled(_episodes(20), 20)
    a = replay.sample(np.random.default_rng(1), 6).copy()
    b = replay.sample(np.random.default_rng(1), 6)
    for name, array in a.arrays().items():
        assert array.tobytes() == b.arrays()[name].tobytes(), name


@pytest.mark.parametrize(("added", "capacity"), [(0, 5), (3, 5), (5, 5), (13, 5)])
def test_state_round_trip_is_bit_for_bit(added: int, capacity: int) -> None:
    episodes = _episodes(added + 4)
    replay = _filled(episodes[:added], capacity)
    state = {name: array.copy() for name, array in replay.state_dict().items()}
    other = _filled(episodes[-3:], capacity)  # dirty: old content must not survive
    other.load_state_dict(state)
    for ring in (replay, other):
        for episode in episodes[added:]:
            ring.add(episode)
    assert len(other) == len(replay)
    assert other.nbytes == replay.nbytes
    for seed in range(3):
        a = replay.sample(np.random.default_rng(seed), 4)
        b = other.sample(np.random.default_rng(seed), 4)
        for name, array in a.arrays().items():
            assert array.tobytes() == b.arrays()[name].tobytes(), name


def test_state_holds_the_filled_part_only() -> None:
    replay = _filled(_episodes(3), 1000)
    stored = sum(array.nbytes for array in replay.state_dict().values())
    assert stored < replay.nbytes + 100 < replay.nbytes_bound / 100


def test_foreign_state_is_refused() -> None:
    state = _filled(_episodes(3), 5).state_dict()
    with pytest.raises(ValueError, match="lacks obs"):
        Replay(5, SIZES).load_state_dict({k: v for k, v in state.items() if k != "obs"})
    with pytest.raises(ValueError, match=r"replay state obs is float32 .*must be float32"):
        Replay(5, replace(SIZES, obs_size=9)).load_state_dict(state)
    with pytest.raises(ValueError, match="capacity of 2"):
        Replay(2, SIZES).load_state_dict(state)


def test_bad_requests_name_the_value() -> None:
    replay = _filled(_episodes(3), 5)
    with pytest.raises(ValueError, match="batch of 4 episodes asked of a replay that holds 3"):
        replay.sample(np.random.default_rng(0), 4)
    with pytest.raises(ValueError, match="capacity is 0"):
        Replay(0, SIZES)
    good = _episodes(1)[0]
    with pytest.raises(ValueError, match=r"episode\.obs is float64"):
        replay.add(replace(good, obs=good.obs.astype(np.float64)))
    with pytest.raises(ValueError, match=r"episode\.actions holds 3; must be 0 to 2"):
        replay.add(replace(good, actions=np.full_like(good.actions, 3)))
    with pytest.raises(ValueError, match="0 steps; must be 1 to 6"):
        replay.add(replace(good, reward=good.reward[:0]))
    assert len(replay) == 3


def _resident_bytes() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="reads Linux's /proc")
def test_memory_follows_what_is_stored() -> None:
    """Capacity costs nothing; half-length episodes take about half of the bound."""
    sizes = Sizes(n_robots=8, n_actions=14, obs_size=128, state_size=216, episode_limit=60)
    before = _resident_bytes()
    replay = Replay(5000, sizes)
    assert replay.nbytes_bound == 5000 * (61 * (4096 + 864 + 112) + 60 * 44 + 18)
    assert _resident_bytes() - before < 8 * 2**20
    episode = random_episode(sizes, np.random.default_rng(0), 30, terminated=True)
    before = _resident_bytes()
    for _ in range(200):
        replay.add(episode)
    grown = _resident_bytes() - before
    assert replay.nbytes == 200 * (31 * (4096 + 864 + 112) + 30 * 44)
    # Six arrays, so at most six partly used pages at either end of each episode's rows.
    assert grown < replay.nbytes + 200 * 12 * 4096
    assert grown < 0.7 * 200 * replay.nbytes_bound / 5000


def test_replay_and_settings_need_no_torch() -> None:
    code = (
        "import sys, policy_pkg.learner.replay, policy_pkg.learner.config;"
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=250)
