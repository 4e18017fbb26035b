"""Train a policy on the ring by analytic gradients, from nothing, and compare it with PI on test seeds.

Short-horizon actor-critic (SHAC, Xu et al. 2022, ICLR): the gradient of the return flows back through 30 s of traffic,
and a critic stands for the time after that.

Run: python examples/differentiable_ring.py [--scenario ring-jammed] [--seed 0] [--updates 40]
"""

import argparse
import time

import torch
from torch import Tensor, nn

import unjam
from unjam.drivers.observation import local_observation
from unjam.drivers.user_driver import as_driver
from unjam.seeds import held_out_seeds
from unjam.worlds.batch.run import run_batches
from unjam.worlds.worker_pool import EpisodeTask

RINGS, WINDOW, GAMMA, LAMBDA = 32, 300, 0.998, 0.95
ACCELERATION_WEIGHT = 4.0
"""that of the scenario's reward [s2/m]"""
BLOCK = 10
"""control steps between two states with which the critic learns"""
MEMORY_SECONDS = torch.tensor([10.0, 40.0, 40.0, 40.0])
"""time constants of the means that the policy remembers: own speed twice, gap, and a one that tells the time"""

parser = argparse.ArgumentParser()
for name, default in {"scenario": "ring", "seed": 0, "updates": 40, "episodes": 20}.items():
    parser.add_argument(f"--{name}", type=type(default), default=default)
options = parser.parse_args()
torch.manual_seed(options.seed)
torch.set_num_threads(1)
scenario = unjam.make_scenario(options.scenario)


def perceptron(inputs: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh(), nn.Linear(hidden, 1)
    )


class Policy(nn.Module):
    """Accelerates to a target speed of 0 to 10 m/s; a driver of unjam, for tensors and for NumPy arrays."""

    time_step = scenario.control_step

    def __init__(self) -> None:
        super().__init__()
        self.network = perceptron(5 + len(MEMORY_SECONDS), 32)
        self.network[-1].weight.data *= 0.01

    def initial_memory(self, n: int) -> dict:
        return {"means": torch.zeros(n, len(MEMORY_SECONDS)).numpy()}

    def recall(self, memory: dict, history: unjam.LocalState) -> dict:
        means = torch.as_tensor(memory["means"])
        for step in range(history.speed.shape[1]):
            means = self.update_means(means, as_tensors(history.select((slice(None), step))))
        return {"means": means.numpy()}

    def update_means(self, means: Tensor, state: unjam.LocalState) -> Tensor:
        now = torch.stack([state.speed / 10, state.speed / 10, state.leader_gap / 20, torch.ones_like(state.speed)], -1)
        return means + self.time_step / MEMORY_SECONDS * (now - means)

    def forward(self, state: unjam.LocalState, means: Tensor) -> tuple[Tensor, Tensor]:
        means = self.update_means(means, state)
        target = 10 * torch.sigmoid(self.network(torch.cat([local_observation(state), means], -1))[:, 0] - 0.5)
        return torch.tanh((target - state.speed) / 3), means

    @torch.no_grad()
    def act(self, state: unjam.LocalState, memory: dict) -> tuple:
        acceleration, means = self(as_tensors(state), torch.as_tensor(memory["means"]))
        return acceleration.double().numpy(), {"means": means.numpy()}


def as_tensors(state: unjam.LocalState) -> unjam.LocalState:
    return state.map(lambda values: torch.tensor(values, dtype=torch.float32))


def critic_inputs(rings: unjam.DifferentiableRings, means: Tensor) -> Tensor:
    speeds = rings.speeds
    whole = [speeds.mean(0) / 5, speeds.std(0) / 3, speeds.min(0).values / 5, rings.loop_lengths / 100 - 2.5]
    return torch.cat([torch.stack(whole, -1), local_observation(rings.exact_state()), means], -1)


def fit_critic(inputs: list[Tensor], rewards: Tensor) -> None:
    """Fit the critic to lambda returns; rewards are those between two of the inputs, shape (blocks, BLOCK, W)."""
    with torch.no_grad():
        later, targets = critic(inputs[-1])[:, 0], []
        discounts = GAMMA ** torch.arange(BLOCK)[:, None]
        for block in reversed(range(len(rewards))):
            bootstrap = LAMBDA * later + (1 - LAMBDA) * critic(inputs[block + 1])[:, 0]
            later = (1 - GAMMA) * (discounts * rewards[block]).sum(0) + GAMMA**BLOCK * bootstrap
            targets.insert(0, later)
    rows, values = torch.cat(inputs[:-1]), torch.cat(targets)
    for _ in range(8):
        batch = torch.randint(len(rows), (256,))
        critic_optimizer.zero_grad()
        nn.functional.mse_loss(critic(rows[batch])[:, 0], values[batch]).backward()
        critic_optimizer.step()


policy, critic = Policy(), perceptron(9 + len(MEMORY_SECONDS), 64)
optimizer = torch.optim.Adam(policy.parameters(), lr=1e-2)
critic_optimizer = torch.optim.Adam(critic.parameters(), lr=3e-3)
schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.02, options.updates)
generator = torch.Generator().manual_seed(options.seed)
started, cpu_started, rings = time.perf_counter(), time.process_time(), None
for update in range(options.updates):
    if rings is None or rings.has_ended:
        seeds = [(options.seed, update, ring) for ring in range(RINGS)]
        rings = unjam.DifferentiableRings(scenario, seeds, dtype=torch.float32, generator=generator)
        memory = rings.initial_memory(policy)
    inputs, rewards = [critic_inputs(rings, memory["means"])], []
    for step in range(min(WINDOW, scenario.horizon - rings.control_steps)):
        acceleration, memory["means"] = policy(rings.local_state(), memory["means"])
        reward = rings.step(acceleration)
        # A command that the safety filter replaces has no gradient, so it costs as much as one that is carried out.
        filtered = abs(acceleration) - abs(rings.last_applied_acceleration())
        rewards.append(reward - ACCELERATION_WEIGHT * filtered)
        if (step + 1) % BLOCK == 0:
            inputs.append(critic_inputs(rings, memory["means"]))
    returns = (1 - GAMMA) * sum(GAMMA**step * reward for step, reward in enumerate(rewards))
    optimizer.zero_grad()
    (-(returns + GAMMA ** len(rewards) * critic(inputs[-1])[:, 0]).mean()).backward()
    nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
    optimizer.step()
    schedule.step()
    memory = rings.detach(memory)
    fit_critic([each.detach() for each in inputs], torch.stack(rewards).detach().unflatten(0, (-1, BLOCK)))
    if update % 10 == 9:
        print(f"update {update + 1}: mean reward {torch.stack(rewards).mean().item():.3f}", flush=True)
wall, cpu = time.perf_counter() - started, time.process_time() - cpu_started
print(f"trained on {options.updates * WINDOW * RINGS:,} environment steps in {wall:.0f} s (CPU time {cpu:.0f} s)")
seeds = held_out_seeds(options.episodes)
returns = dict[str, torch.Tensor]()
for label, driver in {"pi": unjam.make_driver("pi", scenario.control_step), "policy": as_driver(policy)}.items():
    episodes = run_batches([EpisodeTask(scenario, driver, seed) for seed in seeds])
    returns[label] = torch.tensor([episode.reward.sum() for episode in episodes])
gain = returns["policy"] - returns["pi"]
error = 1.96 * gain.std().item() / len(gain) ** 0.5
print(*(f"{label}: return {values.mean().item():.0f}" for label, values in returns.items()), sep="; ", end="; ")
print(
    f"paired difference {gain.mean().item():.0f} +- {error:.0f}, policy better in {int((gain > 0).sum())}/{len(gain)}"
)
