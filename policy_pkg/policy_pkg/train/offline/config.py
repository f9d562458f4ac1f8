"""Settings of training on recorded episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from policy_pkg.learner.config import LearnerConfig
from policy_pkg.train.config import RunSettings, config_names, load_config


class OfflineConfig(RunSettings):
    """One run on a fixed data set. ``configs/train/offline/conservative_qmix.yaml`` shows every
    key and says what it is for."""

    scenario: str | None = Field(
        description="shipped scenario's name, or path of a .yaml file; null: not known here, "
        "then nothing is evaluated"
    )
    method: Literal["q_learning", "behaviour_cloning"] = Field(
        "q_learning", description="q_learning: learner.algorithm; behaviour_cloning: imitates"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="keys everything that is drawn")
    episode_numbers: tuple[int, int] | None = Field(
        None, description="first and last number of the recorded episodes to learn from; null: all"
    )
    gradient_steps: int = Field(20_000, ge=1, description="gradient steps of the run")
    batch_episodes: int = Field(32, ge=1, description="episodes of one gradient step")
    memory_limit_mib: int = Field(
        2_048, ge=1, description="bound of the data set in memory; a larger one is refused"
    )
    crash_weighting: Literal["none", "reweight", "resample"] = Field(
        "none",
        description="how the number of crashed robots comes to follow Binomial(n, crash_rate): "
        "not, by episode weights in the loss, or by drawing episodes so",
    )
    crash_rate: float | None = Field(
        None, ge=0, le=1, description="probability per robot and episode; for crash_weighting"
    )
    test_interval_steps: int = Field(
        1_000, ge=1, description="gradient steps between two evaluation blocks"
    )
    test_episodes: int = Field(32, ge=1, description="greedy episodes of a block per condition")
    test_crashed: tuple[int, ...] = Field(
        (1,), description="numbers of robots that crash in the conditions beside crash-free"
    )
    test_crash_mode: str = Field("mute", description="how they crash")
    checkpoint_interval_steps: int = Field(
        5_000, ge=1, description="gradient steps between two checkpoints, at block ends"
    )
    learner: LearnerConfig = LearnerConfig.model_validate({})

    @model_validator(mode="after")
    def _rate_goes_with_weighting(self) -> Self:
        if self.crash_weighting == "none" and self.crash_rate is not None:
            raise ValueError(
                f"crash_rate {self.crash_rate:g} has no effect with crash_weighting none: "
                "set it to null, or choose reweight or resample"
            )
        if self.crash_weighting != "none" and self.crash_rate is None:
            raise ValueError(f"crash_weighting {self.crash_weighting} needs a crash_rate")
        return self

    @model_validator(mode="after")
    def _numbers_are_a_range(self) -> Self:
        numbers = self.episode_numbers
        if numbers is not None and not 0 <= numbers[0] <= numbers[1]:
            raise ValueError(
                f"episode_numbers {list(numbers)}: must be a first and a last number from 0 on"
            )
        return self

    @model_validator(mode="after")
    def _cloning_has_no_values(self) -> Self:
        if self.method == "behaviour_cloning" and self.learner.conservative_weight > 0:
            raise ValueError(
                f"learner.conservative_weight {self.learner.conservative_weight:g} has no effect "
                "with behaviour_cloning; set it to 0"
            )
        if self.method == "behaviour_cloning" and self.learner.td_lambda > 0:
            raise ValueError(
                f"learner.td_lambda {self.learner.td_lambda:g} has no effect with "
                "behaviour_cloning; set it to 0"
            )
        return self

    @model_validator(mode="after")
    def _counts_are_counts(self) -> Self:
        wrong = [count for count in self.test_crashed if count < 1]
        if wrong or len(set(self.test_crashed)) != len(self.test_crashed):
            raise ValueError(
                f"test_crashed {list(self.test_crashed)}: must be different numbers from 1 on "
                "(crash-free is always evaluated)"
            )
        return self


def offline_config_names() -> tuple[str, ...]:
    """Names of the shipped configs, such as ``offline/conservative_qmix``; sorted."""
    return config_names(offline=True)


def load_offline_config(
    source: str | Path, overrides: Sequence[str] = (), seed: int | None = None
) -> OfflineConfig:
    """Reads a config of `train-offline`; as ``load_config``."""
    return load_config(OfflineConfig, offline_config_names(), source, overrides, seed)
