"""``policy.json``: what an exported model takes, gives and was trained for."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from crash_coach_common.contract import EnvSpec
from policy_pkg.checkpoint import AGENT, PolicyBundle, read_manifest

ABOUT = "policy.json"


class Port(BaseModel):
    """One input or output of the model. ``shape``: sizes, and "rows" for any number of robots."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    dtype: Literal["float32", "int64"]
    shape: tuple[int | Literal["rows"], ...]
    meaning: str


class About(BaseModel):
    """The content of ``policy.json``.

    ``action_names``, ``dt_s``: None where the scenario could not be loaded. ``progress``: how
    long it was trained. ``agent_sha256``: of the checkpoint's file that the model was made from.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["crash-coach-policy"] = "crash-coach-policy"
    version: Literal[1] = 1
    model: str
    scenario: str
    robots: tuple[str, ...]
    action_names: tuple[str, ...] | None
    dt_s: float | None
    progress: dict[str, int | float]
    agent_sha256: str
    obs_size: int
    n_actions: int
    hidden_size: int
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]


def describe(bundle: PolicyBundle, spec: EnvSpec | None, model: str) -> About:
    """Of a model file called ``model``.

    spec: of the scenario that the policy was trained in; None: it could not be loaded.
    """
    sizes = bundle.policy.sizes
    return About(
        model=model,
        scenario=bundle.scenario,
        robots=bundle.robots,
        action_names=None if spec is None else spec.action_names,
        dt_s=None if spec is None else spec.dt_s,
        progress=bundle.meta["progress"],
        agent_sha256=read_manifest(bundle.path).files[AGENT].sha256,
        obs_size=sizes.obs,
        n_actions=sizes.actions,
        hidden_size=sizes.hidden,
        inputs=(
            _port(
                "observation", (sizes.obs,), "what each robot senses, as its scenario lays it out"
            ),
            _index(
                "last_action", "action that it executed in the step before; -1 at the first step"
            ),
            _index("robot", "its place in `robots`, from 0"),
            _port(
                "hidden", (sizes.hidden,), "next_hidden of its step before; zeros at the first step"
            ),
        ),
        outputs=(
            _port(
                "q", (sizes.actions,), "action values; act by the largest of an available action"
            ),
            _port("next_hidden", (sizes.hidden,), "hidden of its next step"),
        ),
    )


def _port(name: str, sizes: tuple[int, ...], meaning: str) -> Port:
    return Port(name=name, dtype="float32", shape=("rows", *sizes), meaning=meaning)


def _index(name: str, meaning: str) -> Port:
    return Port(name=name, dtype="int64", shape=("rows",), meaning=meaning)
