"""A QMIX loop as EPyMARL has it, on an environment of your own in which agents crash.

    pip install torch ./ros_ws/src/crash_coach_common "./crash_coach_pkg[wrappers]"
    python examples/qmix_in_epymarl_style.py --episodes 1000

Put your ParallelEnv in the place of Rally. Everything that a coach asks of a loop is marked with
"coach:"; the rest is QMIX.
"""

from __future__ import annotations

import argparse
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv
from torch import Tensor, nn
from torch.nn import functional

from crash_coach_pkg.wrappers import CrashWrapper, MultiAgentView

STAY, LEFT, RIGHT = 0, 1, 2
LIMIT, HIDDEN, MIX, BATCH, BUFFER = 15, 32, 16, 32, 1000
BLOCK, TESTS, TARGET_EVERY, GAMMA = 100, 50, 50, 0.95
Episode = dict[str, Tensor]


class Rally(ParallelEnv):
    """Two of three agents on a line have to stand on a beacon together, and see only it."""

    metadata: ClassVar[dict[str, Any]] = {"name": "rally_v0"}

    def __init__(self) -> None:
        self.possible_agents = ["ann", "bob", "cleo"]
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        rng = np.random.default_rng(seed)
        self.agents, self.steps = list(self.possible_agents), 0
        self.cells = dict(zip(self.agents, rng.integers(0, 10, 3).tolist(), strict=True))
        self.beacon = int(rng.integers(0, 10))
        return self._observed(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        for agent, action in actions.items():
            move = {STAY: 0, LEFT: -1, RIGHT: 1}[int(action)]
            self.cells[agent] = min(9, max(0, self.cells[agent] + move))
        self.steps += 1
        acting = self.agents
        far = sorted(abs(cell - self.beacon) for cell in self.cells.values())
        rallied, late = far[1] == 0, self.steps >= LIMIT
        self.agents = [] if rallied or late else acting
        reward = 1.0 if rallied else -(far[0] + far[1]) / 100
        return (
            self._observed(), dict.fromkeys(acting, reward), dict.fromkeys(acting, rallied),
            dict.fromkeys(acting, late and not rallied), {agent: {} for agent in acting},
        )  # fmt: skip

    def _observed(self) -> dict[str, Any]:
        """How far away the beacon is, and where."""
        return {
            agent: np.array([(self.beacon - cell) / 9], dtype=np.float32)
            for agent, cell in self.cells.items()
        }


class Agents(nn.Module):
    """One recurrent net for all agents; inputs (B, T, n, O + A + n), values (B, T, n, A)."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, HIDDEN)
        self.memory = nn.GRU(HIDDEN, HIDDEN)
        self.value = nn.Linear(HIDDEN, actions)

    def forward(self, x: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        batch, steps, agents, _ = x.shape
        rows = torch.relu(self.enter(x)).transpose(0, 1).reshape(steps, batch * agents, -1)
        out, hidden = self.memory(rows, hidden)
        return self.value(out).reshape(steps, batch, agents, -1).transpose(0, 1), hidden


class Mixer(nn.Module):
    """(B, T, n) values of the agents and (B, T, S) states to (B, T) values of the team."""

    def __init__(self, state: int, agents: int) -> None:
        super().__init__()
        self.agents = agents
        self.w1, self.b1 = nn.Linear(state, agents * MIX), nn.Linear(state, MIX)
        self.w2 = nn.Linear(state, MIX)
        self.b2 = nn.Sequential(nn.Linear(state, MIX), nn.ReLU(), nn.Linear(MIX, 1))

    def forward(self, q: Tensor, state: Tensor) -> Tensor:
        w1 = self.w1(state).abs().unflatten(-1, (self.agents, MIX))
        inner = functional.elu(torch.einsum("btn,btnm->btm", q, w1) + self.b1(state))
        return (inner * self.w2(state).abs()).sum(-1) + self.b2(state).squeeze(-1)


def one_hot(index: Any, size: int) -> Tensor:
    """(n,) to (n, size); zeros for -1."""
    return (torch.as_tensor(index)[:, None] == torch.arange(size)).float()


class Player:
    """Plays an episode of the environment with the agents' net."""

    def __init__(self, view: MultiAgentView, agents: Agents, info: dict[str, int]) -> None:
        self.view, self.agents, self.info = view, agents, info

    def play(self, epsilon: float, rng: np.random.Generator, seed: int) -> tuple[Episode, bool]:
        n = self.info["n_agents"]
        _, told = self.view.reset(seed=seed)
        rows: list[dict[str, Tensor]] = []
        hidden, last, over, success = None, np.full(n, -1), False, False
        while not over:
            row = self._sensed(last)
            with torch.no_grad():
                q, hidden = self.agents(row["x"][None, None], hidden)
            best = q[0, 0].masked_fill(row["avail"] == 0, -1e9).argmax(-1).numpy()
            uniform = [rng.choice(np.flatnonzero(mask)) for mask in row["avail"].numpy()]
            chosen = np.where(rng.random(n) < epsilon, uniform, best)
            _, rewards, terminated, truncated, told = self.view.step(chosen.tolist())
            # coach: learn from what was executed, which a crashed agent did not choose.
            last = np.array(told["executed_action"])
            over, success = terminated or truncated, terminated
            rows.append({
                **row, "action": torch.as_tensor(last), "reward": torch.tensor(rewards[0]),
                "done": torch.tensor(float(terminated)), "filled": torch.tensor(1.0),
            })  # fmt: skip
        rows.append({**rows[-1], **self._sensed(last), "filled": torch.tensor(0.0)})
        rows += [rows[-1]] * (self.info["episode_limit"] + 1 - len(rows))
        return {key: torch.stack([row[key] for row in rows]) for key in rows[0]}, success

    def _sensed(self, last: Any) -> dict[str, Tensor]:
        n, actions = self.info["n_agents"], self.info["n_actions"]
        seen = torch.as_tensor(np.stack(self.view.get_obs()))
        return {
            "x": torch.cat([seen, one_hot(last, actions), torch.eye(n)], dim=-1),
            "state": torch.as_tensor(self.view.get_state()),
            "avail": torch.as_tensor(self.view.get_avail_actions()),
        }


def loss_of(batch: Episode, nets: list[nn.Module], targets: list[nn.Module]) -> Tensor:
    """QMIX with double Q-learning (Rashid et al. 2018)."""
    q, _ = nets[0](batch["x"])
    with torch.no_grad():
        later, _ = targets[0](batch["x"])
        best = q.masked_fill(batch["avail"] == 0, -1e9).argmax(-1, keepdim=True)
        value = targets[1](later.gather(-1, best).squeeze(-1), batch["state"])[:, 1:]
        goal = batch["reward"] + 0.0
        goal[:, :-1] += GAMMA * (1 - batch["done"][:, :-1]) * value
    chosen = q.gather(-1, batch["action"].unsqueeze(-1)).squeeze(-1)
    error = (nets[1](chosen, batch["state"]) - goal) * batch["filled"]
    return error.square().sum() / batch["filled"].sum()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    torch.manual_seed(asked.seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(asked.seed)
    # coach: around your environment; a greedy team that succeeds in half of its episodes under
    # crashes gets more of them.
    coach = {"strategy": "adaptive", "adaptive": {"beta": 0.5, "rho": 0.05, "alpha_max": 0.3}}
    env = CrashWrapper(Rally(), coach, stay_action=STAY, seed=asked.seed)
    view = MultiAgentView(env, stay_action=STAY, episode_limit=LIMIT)
    view.reset(seed=0)
    info = view.get_env_info()
    inputs = info["obs_shape"] + info["n_actions"] + info["n_agents"]

    def make() -> list[nn.Module]:
        mixer = Mixer(info["state_shape"], info["n_agents"])
        return [Agents(inputs, info["n_actions"]), mixer]

    nets, targets = make(), make()
    parameters = [p for net in nets for p in net.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=1e-3)
    player = Player(view, nets[0], info)
    buffer: list[Episode] = []
    steps = 0
    for episode in range(asked.episodes + 1):
        if episode % TARGET_EVERY == 0:
            for net, target in zip(nets, targets, strict=True):
                target.load_state_dict(net.state_dict())
        if episode % BLOCK == 0:
            # coach: a block of greedy episodes under crashes; their success moves the crash rate.
            rate = np.mean([player.play(0.0, rng, 10**6 + k)[1] for k in range(TESTS)])
            record = env.end_block(float(rate), env_steps=steps)
            print(
                f"episode {episode}: success {record.success_rate:.2f} at crash rate "
                f"{record.rate:.2f}, next crash rate {record.new_rate:.2f}", flush=True,
            )  # fmt: skip
        epsilon = max(0.05, 1 - episode / (0.3 * asked.episodes + 1))
        played, success = player.play(epsilon, rng, episode)
        steps += int(played["filled"].sum())
        # coach: each training episode.
        env.end_episode(success, env_steps=steps)
        buffer = [*buffer[-BUFFER + 1 :], played]
        if len(buffer) >= BATCH:
            picked = [buffer[k] for k in rng.integers(len(buffer), size=BATCH)]
            batch = {key: torch.stack([one[key] for one in picked]) for key in played}
            optimiser.zero_grad()
            loss_of(batch, nets, targets).backward()
            nn.utils.clip_grad_norm_(parameters, 10.0)
            optimiser.step()


if __name__ == "__main__":
    main()
