"""What can a car tell of its road from its own past, and in which form should it remember that?

On rings of the family `unjam:best` drives; each second a network guesses what no message says: how large the
wave is (the spread of all speeds now), how dense the road is, and how many vehicles are on it. It sees one
look, a window of twelve, means over 10, 40 and 160 s, or has a GRU. Trained on the seen rings, asked on fresh
episodes of these and on held-out rings: memory.py OUT.json
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from unjam.controller import make_driver
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.statistics import estimate
from unjam.physics.arrays import Floats
from unjam.training.family import roads_of
from unjam.worlds.batch.run import run_batches
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask

EPISODES, FRESH = 24, 8
"""of each ring to learn from, and to be asked on"""
SCALES = (10.0, 10.0, 30.0)
"""of speed, the leader's speed [m/s] and the gap [m]"""
TARGETS = ("size of the wave", "road for each vehicle", "number of vehicles")
TRAININGS, EPOCHS, PATIENCE = 5, 40, 6
LOOK = 10
"""decisions between two looks: a second"""


def of_episode(episode: Episode) -> tuple[Floats, Floats]:
    """Return looks, shape (CAVs, looks, 3), and what is to be guessed, shape (CAVs, looks, 3)."""
    moments = range(0, episode.steps, LOOK)
    spread = episode.speeds[moments].std(axis=1)
    vehicles = episode.speeds.shape[1]
    truth = np.stack([spread, 0 * spread + episode.loop_length / vehicles, 0 * spread + vehicles], axis=-1)
    looks = [
        np.stack(
            [each.states.speed[moments], each.states.leader_speed[moments], each.states.leader_gap[moments]],
            axis=-1,
        )
        / SCALES
        for each in episode.trajectories
    ]
    return np.stack(looks), np.stack([truth] * len(looks))


def driven(part: str, first: int, count: int) -> dict[str, tuple[Floats, Floats]]:
    """Return looks and truths of each ring, by name."""
    found: dict[str, tuple[Floats, Floats]] = {}
    parts = ("seen",) if part == "seen" else ("combination", "axis")
    for name, ring in roads_of("rings", *parts).items():  # pyright: ignore[reportArgumentType]
        driver = make_driver("unjam:best", ring.decision_step)
        tasks = [EpisodeTask(ring.part(index, count), driver, (7, first + index)) for index in range(count)]
        pairs = [of_episode(episode) for episode in run_batches(tasks)]
        found[name] = np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
    return found


def window(looks: Floats, count: int, apart: int) -> Floats:
    """Return each look with those before it; before the first, the first."""
    moments = np.arange(looks.shape[1])
    past = [looks[:, np.maximum(moments - apart * back, 0)] for back in range(count)]
    return np.concatenate(past, axis=-1)


def means(looks: Floats) -> Floats:
    """Return each look with fading means of speed, its spread and the gap, as a residual can remember."""
    columns = [looks]
    for span in (10.0, 40.0, 160.0):
        fading = 1.0 - np.exp(-1.0 / span)
        watched = np.concatenate([looks[..., [0]], looks[..., [0]] ** 2, looks[..., [2]]], axis=-1)
        kept = np.empty_like(watched)
        mean = watched[:, 0]
        for moment in range(watched.shape[1]):
            mean = mean + max(fading, 1.0 / (moment + 1)) * (watched[:, moment] - mean)
            kept[:, moment] = mean
        kept[..., 1] = np.sqrt(np.maximum(kept[..., 1] - kept[..., 0] ** 2, 0.0))
        columns.append(kept)
    return np.concatenate(columns, axis=-1)


class Recurrent(torch.nn.Module):
    """A GRU over all looks, and what it makes of its state."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.memory = torch.nn.GRU(inputs, 32, batch_first=True)
        self.guess = torch.nn.Sequential(torch.nn.Linear(32, 64), torch.nn.Tanh(), torch.nn.Linear(64, 3))

    def forward(self, looks: torch.Tensor) -> torch.Tensor:
        return self.guess(self.memory(looks)[0])


def plain(inputs: int) -> torch.nn.Module:
    """Return a network as large as a residual's."""
    layers = torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()
    return torch.nn.Sequential(*layers, torch.nn.Linear(64, 3))


Form = tuple[Callable[[Floats], Floats], Callable[[int], torch.nn.Module]]
FORMS: dict[str, Form] = {
    "one look": (lambda looks: looks, plain),
    "twelve looks, a second apart": (lambda looks: window(looks, 12, 1), plain),
    "twelve looks, five seconds apart": (lambda looks: window(looks, 12, 5), plain),
    "means over 10, 40 and 160 s": (means, plain),
    "a GRU of 32": (lambda looks: looks, Recurrent),
}


def trained(
    seen: Floats, truth: Floats, make: Callable[[int], torch.nn.Module], seed: int
) -> torch.nn.Module:
    """Return a network after as many epochs as were best for an eighth of the cars, kept apart."""
    torch.manual_seed(seed)
    order = np.random.default_rng(seed).permutation(len(seen))
    inputs, wanted = torch.tensor(seen, dtype=torch.float32), torch.tensor(truth, dtype=torch.float32)
    kept, learned = order[: len(order) // 8], order[len(order) // 8 :]
    network = make(inputs.shape[-1])
    adam = torch.optim.Adam(network.parameters(), 3e-3, fused=True)
    best, state, since = np.inf, network.state_dict(), 0
    for _ in range(EPOCHS):
        for some in torch.tensor(np.random.default_rng(seed).permutation(learned)).split(16):
            adam.zero_grad()
            (network(inputs[some]) - wanted[some]).square().mean().backward()
            adam.step()
        with torch.no_grad():
            error = float((network(inputs[kept]) - wanted[kept]).square().mean())
        since += 1
        if error < best:
            best, since = error, 0
            state = {name: value.clone() for name, value in network.state_dict().items()}
        if since >= PATIENCE:
            break
    network.load_state_dict(state)
    return network


def main(out: Path) -> None:
    """Measure all forms, and write what each explains."""
    learned_from, asked = driven("seen", 0, EPISODES), {}
    asked["fresh episodes of seen rings"] = driven("seen", 500, FRESH)
    asked["held-out rings"] = driven("held out", 500, FRESH)
    looks = np.concatenate([a for a, _ in learned_from.values()])
    truth = np.concatenate([b for _, b in learned_from.values()])
    middle, scale = truth.mean((0, 1)), truth.std((0, 1))
    found: dict[str, Any] = {"manifest": manifest(), "explained": {}}
    for label, (form, make) in FORMS.items():
        networks = [trained(form(looks), (truth - middle) / scale, make, seed) for seed in range(TRAININGS)]
        found["explained"][label] = {
            which: explained(networks, form, rings, middle, scale) for which, rings in asked.items()
        }
        print(label, found["explained"][label], flush=True)
    write_whole(out, to_json(found, indent=1))


def explained(
    networks: list[torch.nn.Module],
    form: Callable[[Floats], Floats],
    rings: dict[str, tuple[Floats, Floats]],
    middle: Floats,
    scale: Floats,
) -> dict[str, dict[str, float]]:
    """Return the share of the variance that is explained, of each target: mean and interval over networks."""
    looks = np.concatenate([a for a, _ in rings.values()])
    truth = np.concatenate([(b - middle) / scale for _, b in rings.values()])
    with torch.no_grad():
        guesses = [network(torch.tensor(form(looks), dtype=torch.float32)).numpy() for network in networks]
    shares = np.array([1.0 - ((guess - truth) ** 2).mean((0, 1)) / truth.var((0, 1)) for guess in guesses])
    return {
        target: {"mean": round(each.mean, 3), "low": round(each.low, 3), "high": round(each.high, 3)}
        for target, each in ((name, estimate(shares[:, n].tolist())) for n, name in enumerate(TARGETS))
    }


if __name__ == "__main__":
    torch.set_num_threads(1)  # small products wait for threads
    main(Path(sys.argv[1]))
