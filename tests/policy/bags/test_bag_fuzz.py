"""Mutated recordings: never a traceback, never an episode that was not played."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from bag_maker import Made, Team, messages, write
from test_bag_round_trip import same

from policy_pkg.bags.dataset import load_episodes
from policy_pkg.bags.problems import Problem
from policy_pkg.bags.writer import Split

_LIMIT_S = 20.0


def flipped(data: bytearray, rng: np.random.Generator) -> bytearray:
    for _ in range(int(rng.integers(1, 9))):
        data[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
    return data


def truncated(data: bytearray, rng: np.random.Generator) -> bytearray:
    return data[: int(rng.integers(len(data)))]


def moved(data: bytearray, rng: np.random.Generator) -> bytearray:
    """A piece goes somewhere else, or is there twice, or is overwritten by another."""
    a, b = sorted(int(value) for value in rng.integers(len(data), size=2))
    to = int(rng.integers(len(data)))
    piece = data[a : min(b, a + 4000)]
    if rng.random() < 0.3:
        data[to : to + len(piece)] = piece
        return data
    if rng.random() < 0.5:
        del data[a : a + len(piece)]
    data[to:to] = piece
    return data


MUTATIONS = (flipped, truncated, moved)


def check(folder: Path, data: bytes, made: list[Made], rng: np.random.Generator) -> int:
    """Reads one mutated file; returns how many episodes survived."""
    mutated = bytearray(data)
    for _ in range(int(rng.integers(1, 3))):
        mutated = MUTATIONS[int(rng.integers(len(MUTATIONS)))](mutated, rng)
        if not mutated:
            break
    (folder / "bag_0.mcap").write_bytes(mutated)
    problems: list[Problem] = []
    start = time.monotonic()
    got = list(load_episodes([folder], report=problems.append))
    assert time.monotonic() - start < _LIMIT_S
    for one in got:
        same(made[one.number], one)
    assert len(got) == len(made) or problems, "something was lost and not told"
    for problem in problems:
        assert "\n" not in str(problem)
    return len(got)


def fuzz(tmp_path: Path, team: Team, made: list[Made], rounds: int, compression: str) -> None:
    rng = np.random.default_rng(rounds)
    # Small chunks, so that damage does not take the whole file with it.
    folder = write(tmp_path / "bag", team, messages(made), Split(), compression, flush_every=150)
    data = (folder / "bag_0.mcap").read_bytes()
    survived = [check(folder, data, made, rng) for _ in range(rounds)]
    assert 0 < sum(survived) < rounds * len(made)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_mutated_recordings(tmp_path: Path, team: Team, made: list[Made], compression: str) -> None:
    fuzz(tmp_path, team, made, 15, compression)


@pytest.mark.soak
@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_thousand_mutated_recordings(
    tmp_path: Path, team: Team, made: list[Made], compression: str
) -> None:
    fuzz(tmp_path, team, made, 334, compression)
