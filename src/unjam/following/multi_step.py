"""Learning to drive on from one's own predictions: a residual trained through the simulated steps.

A network that learned single accelerations has never seen where its own small errors lead. Here the loss is
the error of the simulated gap, and its gradient runs back through every step behind a recorded leader.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from torch import Tensor

from unjam.errors import UnjamError
from unjam.following.network import FollowingNetwork, NetworkSettings, on_rows
from unjam.following.open_loop import Limits, Model, drive_behind, open_loop, personal_idm, with_residual
from unjam.following.pairs import Pair, Stretches, rows_of, stretches_of
from unjam.parameters import STRICT, Count, NotNegative, Positive
from unjam.physics.idm import IDMParameters, IDMRows, parameter_rows

SMALLEST = 1e-2
"""what is added to a mean square before its root [m2]: a perfect trajectory has no infinite slope"""
LARGEST_GRADIENT = 1.0
"""norm to which gradients are cut: those through many steps can be very long"""


@checked_dataclass(frozen=True, config=STRICT)
class MultiStepSettings:
    """How a residual learns from simulated driving."""

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (32, 32)
    """units of the hidden layers"""
    authority: Positive = 2.0
    """largest residual [m/s2]"""
    seconds: Positive = 30.0
    """length of the stretches that are simulated"""
    batch: Count = 64
    """stretches in a gradient step"""
    steps: Count = 120
    """gradient steps"""
    rate: Positive = 1e-3
    """learning rate of Adam, which falls to zero as a cosine"""
    speed_weight: NotNegative = 2.0
    """how much an error of the speed by 1 m/s counts beside one of the gap by 1 m"""
    residual_weight: NotNegative = 0.1
    """how much the squared residual counts: where data are silent, the base drives"""
    validate_every: Count = 20
    """gradient steps between two looks at the validation trajectories, which choose the weights"""


@dataclass(frozen=True)
class MultiStepFit:
    """A residual, and how it came to be."""

    network: FollowingNetwork
    validation: list[float]
    """mean over the validation trajectories of the root mean squared error of the gap [m], by look; the
    first is the base's"""


@dataclass(frozen=True)
class Known:
    """Trajectories, and what is known of who drove them before a residual is learned."""

    pairs: Sequence[Pair]
    drivers: Sequence[IDMParameters]
    """of each trajectory"""
    kept_headway: float = 0.0
    """of `personal_idm`"""

    def model(self, owner: NDArray[np.int64], limits: Limits, tensors: bool = False) -> Model:
        """Return the base of stretches that are of the trajectories `owner`; for NumPy or for torch."""
        rows = parameter_rows([self.drivers[number] for number in owner])
        if tensors:
            rows = IDMRows(*(torch.as_tensor(values, dtype=torch.float32) for values in rows))
        return personal_idm(rows, self.kept_headway, limits)


def fit_multi_step(
    known: Known,
    validation: Known,
    limits: Limits,
    settings: MultiStepSettings,
    seed: int,
    told: Callable[[int], None] | None = None,
) -> MultiStepFit:
    """Return a residual on what is known that makes the simulated gaps those of the trajectories.

    It starts at zero, so that what drives at first is the base alone, and ends with the weights that were
    best on whole trajectories of `validation`; these may be the first.

    Args:
        known: to learn from.
        validation: of other drivers.
        limits: of the acceleration [m/s2].
        settings: of network and learning.
        seed: of the first weights and the order of the stretches.
        told: told the number of each gradient step.

    Raises:
        UnjamError: a loss is not finite.
    """
    torch.set_num_threads(1)
    shape = NetworkSettings(hidden=settings.hidden, authority=settings.authority)
    network = FollowingNetwork(shape, rows_of(known.pairs), seed, zero=True)
    stretches, judged = stretches_of(known.pairs, settings.seconds), stretches_of(validation.pairs)
    optimizer = torch.optim.Adam(network.parameters(), lr=settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
    generator = np.random.default_rng(seed)
    base = validation.model(judged.owner, limits)
    found = [_judged(network, base, limits, judged)]
    kept = {name: value.clone() for name, value in network.state_dict().items()}
    for step in range(1, settings.steps + 1):
        chosen = generator.choice(stretches.gap.shape[1], settings.batch)
        part = stretches.some(chosen)
        loss = _loss(network, known.model(part.owner, limits, tensors=True), limits, part, settings)
        if not torch.isfinite(loss):
            raise UnjamError(f"following network: the loss of step {step} is not finite")
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
        optimizer.step()
        schedule.step()
        if step % settings.validate_every == 0:
            found.append(_judged(network, base, limits, judged))
            if found[-1] <= min(found):
                kept = {name: value.clone() for name, value in network.state_dict().items()}
        if told is not None:
            told(step)
    network.load_state_dict(kept)
    return MultiStepFit(network, found)


def _judged(network: FollowingNetwork, base: Model, limits: Limits, judged: Stretches) -> float:
    drove = open_loop(with_residual(base, on_rows(network.as_driver()), limits), judged)
    return float(np.sqrt(drove.gap_square).mean())


def _loss(
    network: FollowingNetwork, base: Model, limits: Limits, real: Stretches, settings: MultiStepSettings
) -> Tensor:
    """Return the loss of driving behind the leaders of some stretches."""
    speeds, leader_speeds, gaps, paths = (
        torch.as_tensor(values, dtype=torch.float32)
        for values in (real.speed, real.leader_speed, real.gap, real.leader_path)
    )
    present = torch.as_tensor(real.present)[1:]
    residuals: list[Tensor] = []

    def noted(inputs: Tensor) -> Tensor:
        residuals.append(network(inputs))
        return residuals[-1]

    follow = with_residual(base, noted, limits)(speeds[0], gaps[0])
    driven = list(drive_behind(follow, (speeds[0], gaps[0]), (leader_speeds, paths), real.step))
    speed, gap = (torch.stack(each) for each in zip(*driven, strict=True))
    moments = present.sum(0)
    squares = (gap - gaps[1:]).square() + (settings.speed_weight * (speed - speeds[1:])).square()
    left = torch.stack(residuals).square()[present].mean()
    return ((squares * present).sum(0) / moments + SMALLEST).sqrt().mean() + settings.residual_weight * left
