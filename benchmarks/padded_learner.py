"""Reference for the benchmark: a plain learner, as PyMARL's, on padded batches.

Every episode is padded to the longest of the batch; online and target net are each unrolled by a
loop over time around torch.nn.GRUCell; autograd does the rest. Same networks, same loss, same
optimiser as the product (QMIX, double Q), so that the times can be compared.
"""

from __future__ import annotations

import copy

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy_pkg.episode import Episode, Sizes


class PaddedAgent(nn.Module):
    """Linear - ReLU - GRUCell - Linear, one time step."""

    def __init__(self, sizes: Sizes, hidden: int = 64) -> None:
        super().__init__()
        self.fc1 = nn.Linear(sizes.input_size, hidden)
        self.rnn = nn.GRUCell(hidden, hidden)
        self.fc2 = nn.Linear(hidden, sizes.n_actions)

    def forward(self, inputs: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.rnn(F.relu(self.fc1(inputs)), hidden)
        return self.fc2(hidden), hidden


class PaddedMixer(nn.Module):
    """QMIX: the weights of a two-layer net come from hypernetworks of the state."""

    def __init__(self, sizes: Sizes, mixing: int = 32, hyper: int = 64) -> None:
        super().__init__()
        self.n, self.mixing = sizes.n_robots, mixing
        state = sizes.state_size
        self.w1 = nn.Sequential(
            nn.Linear(state, hyper), nn.ReLU(), nn.Linear(hyper, self.n * mixing)
        )
        self.w2 = nn.Sequential(nn.Linear(state, hyper), nn.ReLU(), nn.Linear(hyper, mixing))
        self.b1 = nn.Linear(state, mixing)
        self.v = nn.Sequential(nn.Linear(state, mixing), nn.ReLU(), nn.Linear(mixing, 1))

    def forward(self, q: Tensor, state: Tensor) -> Tensor:
        """q: (B, T, n), state: (B, T, S) -> (B, T)."""
        shape = q.shape[:2]
        q, state = q.reshape(-1, 1, self.n), state.reshape(-1, state.shape[-1])
        w1 = self.w1(state).abs().view(-1, self.n, self.mixing)
        w2 = self.w2(state).abs().view(-1, self.mixing, 1)
        inner = F.elu(torch.bmm(q, w1) + self.b1(state).unsqueeze(1))
        total: Tensor = torch.bmm(inner, w2).view(-1) + self.v(state).view(-1)
        return total.view(shape)


class PaddedReplay:
    """Episodes in arrays (B, T_max + 1, ...), zero after their end."""

    def __init__(self, sizes: Sizes, episodes: list[Episode]) -> None:
        count, steps, n = len(episodes), sizes.episode_limit, sizes.n_robots
        self.sizes = sizes
        self.obs = torch.zeros(count, steps + 1, n, sizes.obs_size)
        self.state = torch.zeros(count, steps + 1, sizes.state_size)
        self.available = torch.ones(count, steps + 1, n, sizes.n_actions, dtype=torch.bool)
        self.actions = torch.zeros(count, steps, n, dtype=torch.int64)
        self.reward = torch.zeros(count, steps)
        self.terminated = torch.zeros(count, steps)
        self.valid = torch.zeros(count, steps)
        for i, episode in enumerate(episodes):
            length = episode.length
            self.obs[i, : length + 1] = torch.from_numpy(episode.obs)
            self.state[i, : length + 1] = torch.from_numpy(episode.state)
            self.available[i, : length + 1] = torch.from_numpy(episode.available)
            self.actions[i, :length] = torch.from_numpy(episode.actions)
            self.reward[i, :length] = torch.from_numpy(episode.reward)
            self.terminated[i, length - 1] = float(episode.terminated)
            self.valid[i, :length] = 1.0


class PaddedLearner:
    """One QMIX gradient step per ``update``."""

    def __init__(self, sizes: Sizes, seed: int, gamma: float = 0.99) -> None:
        torch.manual_seed(seed)
        self.sizes, self.gamma = sizes, gamma
        self.agent, self.mixer = PaddedAgent(sizes), PaddedMixer(sizes)
        self.target_agent = copy.deepcopy(self.agent)
        self.target_mixer = copy.deepcopy(self.mixer)
        self.params = [*self.agent.parameters(), *self.mixer.parameters()]
        self.optimiser = torch.optim.RMSprop(self.params, lr=5e-4, alpha=0.99, eps=1e-5)

    def update(self, replay: PaddedReplay, slots: np.ndarray) -> float:
        """The gradient step on the given episodes; returns the loss."""
        index = torch.from_numpy(slots)
        steps = int(replay.valid[index].sum(1).max())
        obs, state = replay.obs[index, : steps + 1], replay.state[index, : steps + 1]
        available, actions = replay.available[index, : steps + 1], replay.actions[index, :steps]
        reward, valid = replay.reward[index, :steps], replay.valid[index, :steps]
        terminated = replay.terminated[index, :steps]
        inputs = self._inputs(obs, actions)
        q = self._unroll(self.agent, inputs)
        taken = q[:, :-1].gather(3, actions.unsqueeze(3)).squeeze(3)
        with torch.no_grad():
            target_q = self._unroll(self.target_agent, inputs)
            best = q.detach().masked_fill(~available, -1e9)[:, 1:].argmax(3, keepdim=True)
            following = target_q[:, 1:].gather(3, best).squeeze(3)
            target = reward + self.gamma * (1 - terminated) * self.target_mixer(
                following, state[:, 1:]
            )
        error = (self.mixer(taken, state[:, :-1]) - target) * valid
        loss = error.square().sum() / valid.sum()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.params, 10.0)
        self.optimiser.step()
        return float(loss.detach())

    def _inputs(self, obs: Tensor, actions: Tensor) -> Tensor:
        """(B, T+1, n, O+A+n): observation, last action one-hot, robot one-hot."""
        batch, times, n = obs.shape[:3]
        last = torch.zeros(batch, times, n, self.sizes.n_actions)
        last[:, 1:] = F.one_hot(actions, self.sizes.n_actions).float()
        robot = torch.eye(n).expand(batch, times, n, n)
        return torch.cat((obs, last, robot), 3)

    def _unroll(self, agent: PaddedAgent, inputs: Tensor) -> Tensor:
        batch, times, n = inputs.shape[:3]
        hidden = torch.zeros(batch * n, agent.rnn.hidden_size)
        values = []
        for t in range(times):
            q, hidden = agent(inputs[:, t].reshape(batch * n, -1), hidden)
            values.append(q.view(batch, n, -1))
        return torch.stack(values, 1)
