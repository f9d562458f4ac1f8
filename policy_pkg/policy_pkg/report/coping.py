"""When a method's teams cope: succeed crash-free and with each robot crashed, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from policy_pkg.report.kept_evaluations import Result
from policy_pkg.report.training import LAST_BLOCKS


@dataclass(frozen=True)
class Coping:
    """Of the runs of a method on a map that tested each robot crashed in their blocks.

    ``at_end``: whether each coped in its last block. ``last``: in how many of its last LAST_BLOCKS
    blocks, ``last_blocks`` in all. ``first_steps``: when first; None: never.
    """

    scenario: str
    method: str
    seeds: tuple[int, ...]
    at_end: tuple[bool, ...]
    last: tuple[int, ...]
    last_blocks: int
    first_steps: tuple[int | None, ...]


def coping(results: Sequence[Result]) -> list[Coping]:
    """Maps and methods in the order of the results, seeds ascending."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in sorted(results, key=lambda result: result.run.seed):
        if result.training.coped:
            groups.setdefault((result.run.scenario, result.run.method), []).append(result)
    order = dict.fromkeys((result.run.scenario, result.run.method) for result in results)
    return [_coping(*group, groups[group]) for group in order if group in groups]


def _coping(scenario: str, method: str, results: Sequence[Result]) -> Coping:
    blocks = [result.training.coped for result in results]
    last = [[copes for _, copes in each[-LAST_BLOCKS:]] for each in blocks]
    return Coping(
        scenario,
        method,
        seeds=tuple(result.run.seed for result in results),
        at_end=tuple(each[-1] for each in last),
        last=tuple(map(sum, last)),
        last_blocks=sum(map(len, last)),
        first_steps=tuple(next((s for s, copes in each if copes), None) for each in blocks),
    )
