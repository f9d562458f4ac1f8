"""Settings of the learner. No torch here: configs are read where none is installed."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

MIXER_GROUP = "crash_coach.mixers"
ALGORITHMS = ("qmix", "vdn", "iql")


def algorithm_names() -> tuple[str, ...]:
    """Ours, then the mixers of other packages."""
    return tuple(
        dict.fromkeys((*ALGORITHMS, *(point.name for point in entry_points(group=MIXER_GROUP))))
    )


class LearnerConfig(BaseModel):
    """Value-based learner with PyMARL's semantics; the defaults are the paper's values."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    algorithm: str = Field(
        default="qmix",
        description="qmix: monotonic mixer; vdn: sum; iql: team reward to each robot; or the name "
        "of another package's mixer",
    )
    device: Literal["cpu", "cuda"] = Field(
        default="cpu", description="where the gradient steps are computed; acting stays on the CPU"
    )
    hidden: int = Field(
        default=64, ge=1, le=4096, description="units of the agent net's layers and GRU"
    )
    mixing_hidden: int = Field(
        default=32, ge=1, le=4096, description="units of the QMIX mixing layer"
    )
    hypernet_hidden: int = Field(
        default=64, ge=1, le=4096, description="units of the QMIX hypernetworks"
    )
    gamma: float = Field(default=0.99, ge=0.0, le=1.0, description="discount per environment step")
    lr: float = Field(default=5e-4, gt=0.0, le=1.0, description="learning rate")
    optimiser: Literal["rmsprop", "adam"] = Field(default="rmsprop", description="gradient method")
    optim_alpha: float = Field(
        default=0.99,
        ge=0.0,
        lt=1.0,
        description="smoothing of RMSprop's squared gradient; unused by adam",
    )
    optim_eps: float = Field(
        default=1e-5, gt=0.0, le=1.0, description="added to the root; both optimisers"
    )
    grad_norm_clip: float = Field(
        default=10.0, gt=0.0, description="bound of the joint gradient norm of agent net and mixer"
    )
    target_update_interval_episodes: int = Field(
        default=200,
        ge=1,
        description="finished training episodes between two copies to the target nets",
    )
    td_lambda: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="share of the lambda-return in the target; 0: one-step targets",
    )
    double_q: bool = Field(
        default=True,
        description="choose the next action by the online net, value it by the target net",
    )
    crashed_loss: Literal["keep", "drop"] = Field(
        default="keep", description="drop: crashed robots do not enter the loss (iql only)"
    )
    crashed_target: Literal["max", "mean", "stay"] = Field(
        default="max",
        description="next value of a crashed robot: best action, mean over the available "
        "actions (random crash), or the stay action's value",
    )
    conservative_weight: float = Field(
        default=0.0,
        ge=0.0,
        le=1e6,
        description="factor of the conservative term, for fixed data; 0: none",
    )
    crashed_conservative: Literal["keep", "drop"] = Field(
        default="drop",
        description="drop: crashed robot-steps do not enter the conservative term, since what "
        "they executed was not the policy's choice",
    )

    @field_validator("algorithm")
    @classmethod
    def _known(cls, algorithm: str) -> str:
        if algorithm not in ALGORITHMS and algorithm not in algorithm_names():
            raise ValueError(
                f"unknown algorithm {algorithm!r}; one of: {', '.join(algorithm_names())}"
            )
        return algorithm

    @model_validator(mode="after")
    def _drop_needs_iql(self) -> Self:
        if self.crashed_loss == "drop" and self.algorithm != "iql":
            raise ValueError(
                f"crashed_loss=drop needs algorithm=iql, not {self.algorithm}: "
                "with a mixer the whole team has one loss"
            )
        return self
