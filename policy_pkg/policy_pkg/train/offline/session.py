"""All of an offline run that changes while it runs, and the evaluation beside it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BatchEnv, UserError
from policy_pkg.learner.cloner import Cloner
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Batch
from policy_pkg.play.conditions import Condition, crash_free, exactly
from policy_pkg.play.evaluate import evaluate_in
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.blocks import Schedule
from policy_pkg.train.metrics import Means, Value
from policy_pkg.train.offline.config import OfflineConfig
from policy_pkg.train.offline.crash_weights import CrashWeights, crash_weights
from policy_pkg.train.offline.data import FixedData
from policy_pkg.train.session import SAMPLING, TEST_KEY, generator
from policy_pkg.train.snapshot import Team

UNKNOWN_SCENARIO = "unknown"
MEANS = (
    "loss",
    "grad_norm",
    "conservative",
    "td_error_abs",
    "q_taken_mean",
    "target_mean",
    "agreement",
)


@dataclass(frozen=True)
class _Test:
    """One condition of the evaluation blocks; its figures end in ``label``."""

    label: str
    condition: Condition


class OfflineSession:
    """Draws batches, learns and tests; knows nothing of files and clocks.

    Args:
        config: of the run.
        data: the recordings.
        test_env: for evaluation blocks, used by nothing else; None: the scenario is not known.

    Raises:
        UserError: the config does not fit the recordings or the scenario.
    """

    VERB: ClassVar[str] = "train-offline"
    STEPS: ClassVar[str] = "gradient_steps"
    alpha = epsilon = None
    best_is_now = False
    stems = ("learner",)

    def __init__(self, config: OfflineConfig, data: FixedData, test_env: BatchEnv | None) -> None:
        self.config, self.data, self._test_env = config, data, test_env
        self.schedule, self.means = Schedule(), Means()
        sizes = data.sizes
        self._check(sizes.n_robots)
        self.weights = self._crash_weights()
        self.sampling = generator(config.seed, SAMPLING)
        self.learner: Learner | Cloner
        if config.method == "q_learning":
            self.learner = Learner(config.learner, sizes, config.seed)
        else:
            self.learner = Cloner(config.learner, sizes, config.seed)
        self.policy = RecurrentPolicy(self.learner.agent_weights(), sizes.n_robots, sizes.n_actions)
        self._tests = self._conditions()

    def _check(self, n_robots: int) -> None:
        config, held = self.config, len(self.data)
        if config.crash_weighting != "resample" and config.batch_episodes > held:
            raise UserError(
                f"batch_episodes {config.batch_episodes} is more than the {held} recorded episodes"
            )
        if self._test_env is None and config.learner.crashed_target == "stay":
            raise UserError("learner.crashed_target stay needs a scenario: which actions stay?")
        over = [count for count in config.test_crashed if count > n_robots]
        if over:
            raise UserError(f"test_crashed {over[0]}: the team has {n_robots} robots")

    def _crash_weights(self) -> CrashWeights | None:
        if self.config.crash_rate is None:
            return None
        return crash_weights(self.data.crashed, self.data.sizes.n_robots, self.config.crash_rate)

    def _conditions(self) -> tuple[_Test, ...]:
        mode = self.config.test_crash_mode
        try:
            crashed = [
                _Test(f"{count}_crashed", exactly(count, mode))
                for count in self.config.test_crashed
            ]
        except ValueError as error:
            raise UserError(f"test_crash_mode {mode!r}: {error}") from error
        return (_Test("crash_free", crash_free()), *crashed)

    @property
    def team(self) -> Team:
        sizes, scenario = self.data.sizes, self.config.scenario or UNKNOWN_SCENARIO
        return Team(scenario, self.data.robots, sizes.n_actions, sizes.obs_size)

    @property
    def steps(self) -> int:
        return self.learner.updates

    @property
    def total_steps(self) -> int:
        return self.config.gradient_steps

    @property
    def episodes(self) -> int:
        return len(self.data)

    @property
    def finished(self) -> bool:
        return self.schedule.finished(self.steps, self.total_steps)

    @property
    def block_due(self) -> bool:
        return self.schedule.due(self.steps)

    def advance(self) -> None:
        """One gradient step.

        Raises:
            DivergedError: from the learner.
        """
        batch = self.data.episodes.gather(self._draw())
        weights: npt.NDArray[Any] | None = None
        if self.weights is not None and self.config.crash_weighting == "reweight":
            weights = self.weights.weights[batch.slots]
        self.means.add(self._update(batch, weights))

    def _draw(self) -> npt.NDArray[np.int64]:
        """Which episodes: different ones, each set equally likely; resampled: independent ones."""
        count, held = self.config.batch_episodes, len(self.data)
        if self.weights is not None and self.config.crash_weighting == "resample":
            probability = self.weights.weights / self.weights.weights.sum()
            return self.sampling.choice(held, size=count, p=probability)
        return self.sampling.choice(held, size=count, replace=False, shuffle=False)

    def _update(self, batch: Batch, weights: npt.NDArray[Any] | None) -> dict[str, float]:
        if isinstance(self.learner, Cloner):
            return self.learner.update(batch, weights=weights)
        # The target copies are counted in episodes; here a gradient step counts as one.
        return self.learner.update(batch, episodes=self.steps + 1, weights=weights)

    def _test(self) -> dict[str, Value]:
        """Plays the block's episodes greedily under each condition; each block has its own."""
        self.policy.set_weights(self.learner.agent_weights())
        count, env = self.config.test_episodes, self._test_env
        episodes = range(self.schedule.blocks * count, (self.schedule.blocks + 1) * count)
        figures: dict[str, Value] = {}
        for test in self._tests:
            success: float | None = None
            mean_return: float | None = None
            if env is not None:
                seed = self.config.seed ^ TEST_KEY
                played = evaluate_in(env, self.policy, test.condition, episodes, seed)
                success = played.success_rate if env.spec.reports_success else None
                mean_return = played.return_mean
            figures[f"success_{test.label}"] = success
            figures[f"return_{test.label}"] = mean_return
        return figures

    def end_block(self) -> dict[str, Value]:
        """Tests the policy; the block's line of metrics."""
        figures, steps, config = self._test(), self.steps, self.config
        self.schedule.close(steps, config.test_interval_steps, config.gradient_steps)
        return {
            "gradient_steps": steps,
            "epochs": steps * config.batch_episodes / len(self.data),
            **figures,
            **self.means.take(MEANS),
        }

    def counts(self) -> dict[str, int | float]:
        return {"gradient_steps": self.steps, **asdict(self.schedule)}

    def state_dict(self) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
        """Tensor files by stem, and JSON values."""
        learner, learner_values = self.learner.state_dict()
        values = {
            "learner": learner_values,
            "sampling": dict(self.sampling.bit_generator.state),
            "means": self.means.state_dict(),
        }
        return {"agent": self.learner.agent_weights(), "learner": learner}, values

    def load_state_dict(
        self,
        tensors: dict[str, dict[str, Any]],
        values: dict[str, Any],
        counts: dict[str, Any],
    ) -> None:
        """Continues from what ``state_dict`` and ``counts`` gave.

        Raises:
            ValueError, KeyError, TypeError: it is of something else, or incomplete.
        """
        self.learner.load_state_dict(tensors["learner"], values["learner"])
        self.sampling.bit_generator.state = values["sampling"]
        self.means.load_state_dict(values["means"])
        blocks = {key: int(counts[key]) for key in ("blocks", "next_block_steps")}
        self.schedule = Schedule(**blocks)
        self.schedule.bound(self.steps, self.total_steps)
