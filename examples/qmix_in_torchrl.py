"""QMIX of TorchRL's parts, on an environment of your own in which agents crash.

    pip install torchrl ./ros_ws/src/crash_coach_common "./crash_coach_pkg[wrappers]"
    python examples/qmix_in_torchrl.py --episodes 400

Rally stands in the example in EPyMARL's style; put your ParallelEnv in its place. Everything that a
coach asks of a loop is marked with "coach:"; the rest is TorchRL.
"""

from __future__ import annotations

import argparse

import torch
from qmix_in_epymarl_style import LIMIT, STAY, Rally
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import FlattenObservation, TransformedEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.modules.models.multiagent import MultiAgentMLP, QMixer
from torchrl.objectives import SoftUpdate, ValueEstimators
from torchrl.objectives.multiagent import QMixerLoss

from crash_coach_pkg.wrappers import CrashWrapper

ACTIONS, HIDDEN, BATCH, BUFFER = 3, 64, 256, 20_000
BLOCK, TESTS, UPDATES, GAMMA = 100, 50, 8, 0.95
SEEN, ACTION, VALUES = ("agents", "observation"), ("agents", "action"), ("agents", "action_value")
CHOSEN, EXECUTED = ("agents", "chosen_action_value"), ("next", "agents", "info", "executed_action")


def make_nets(agents: int, seen: int) -> tuple[TensorDictSequential, TensorDictModule]:
    """The agents' net, shared by all, and QMIX's mixer, whose state is all they see."""
    net = MultiAgentMLP(
        seen, ACTIONS, agents, centralized=False, share_params=True, depth=2, num_cells=HIDDEN
    )
    values = TensorDictModule(net, in_keys=[SEEN], out_keys=[VALUES])
    choice = QValueModule(
        action_value_key=VALUES, out_keys=[ACTION, VALUES, CHOSEN], action_space="categorical"
    )
    mixer = QMixer(state_shape=(agents * seen,), mixing_embed_dim=16, n_agents=agents, device="cpu")
    mixed = TensorDictModule(mixer, in_keys=[CHOSEN, "state"], out_keys=["chosen_action_value"])
    return TensorDictSequential(values, choice), mixed


def make_loss(team: TensorDictSequential, mixer: TensorDictModule) -> QMixerLoss:
    loss = QMixerLoss(team, mixer, delay_value=True, action_space="categorical")
    loss.set_keys(
        action=ACTION, action_value=VALUES, local_value=CHOSEN, global_value="chosen_action_value",
        reward="reward", done="done", terminated="terminated",
    )  # fmt: skip
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    return loss


def play(env: TransformedEnv, policy: TensorDictModule, seed: int) -> TensorDict:
    """An episode, step by step: (T,)."""
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        return env.rollout(LIMIT, policy, auto_reset=False, tensordict=env.reset(seed=seed))


def succeeded(episode: TensorDict) -> bool:
    return bool(episode["next", "terminated"].any())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=800)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    torch.manual_seed(asked.seed)
    torch.set_num_threads(1)
    # coach: around your environment; a greedy team that succeeds in half of its episodes under
    # crashes gets more of them.
    settings = {"strategy": "adaptive", "adaptive": {"beta": 0.5, "rho": 0.05, "alpha_max": 0.3}}
    coached = CrashWrapper(Rally(), settings, stay_action=STAY, seed=asked.seed)
    names = coached.possible_agents
    plain = PettingZooWrapper(coached, group_map={"agents": names}, categorical_actions=True)
    joined = FlattenObservation(-2, -1, in_keys=[SEEN], out_keys=["state"])
    env = TransformedEnv(plain, joined)
    team, mixer = make_nets(len(names), plain.observation_spec[SEEN].shape[-1])
    explore = EGreedyModule(env.full_action_spec[ACTION], 1.0, 0.05, action_key=ACTION)
    explore.annealing_num_steps = int(0.3 * asked.episodes * LIMIT) + 1
    policy = TensorDictSequential(team, explore)
    loss = make_loss(team, mixer)
    update, optimiser = SoftUpdate(loss, tau=0.01), torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(BUFFER), batch_size=BATCH)
    steps = 0
    for number in range(asked.episodes + 1):
        if number % BLOCK == 0:
            # coach: a block of greedy episodes under crashes; their success moves the crash rate.
            rate = sum(succeeded(play(env, team, 10**6 + k)) for k in range(TESTS)) / TESTS
            record = coached.end_block(rate, env_steps=steps)
            print(
                f"episode {number}: success {record.success_rate:.2f} at crash rate "
                f"{record.rate:.2f}, next crash rate {record.new_rate:.2f}", flush=True,
            )  # fmt: skip
        episode = play(env, policy, number)
        steps += len(episode)
        explore.step(len(episode))
        # coach: each training episode.
        coached.end_episode(succeeded(episode), env_steps=steps)
        # coach: learn from what was executed, which a crashed agent did not choose.
        episode[ACTION] = episode[EXECUTED].to(episode[ACTION].dtype)
        episode["next", "reward"] = episode["next", "agents", "reward"].mean(-2)
        buffer.extend(episode)
        for _ in range(UPDATES if len(buffer) >= BATCH else 0):
            optimiser.zero_grad()
            loss(buffer.sample())["loss"].backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 10.0)
            optimiser.step()
            update.step()


if __name__ == "__main__":
    main()
