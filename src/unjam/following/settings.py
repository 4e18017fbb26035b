"""What decides how networks learn to follow. Free of torch: populations are calibrated without it."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt

HiddenSizes = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]


@checked_dataclass(frozen=True, config=STRICT)
class NetworkSettings:
    """A network and how it learns single accelerations; the defaults are the paper's."""

    hidden: HiddenSizes = (128, 128)
    """units of the hidden layers"""
    learning_rate: Positive = 1e-4
    """learning rate of Adam"""
    batch_size: PositiveInt = 1024
    """moments in a gradient step"""
    epochs: PositiveInt = 200
    """most passes over the moments"""
    patience: PositiveInt = 200
    """passes without progress in validation after which learning ends; as many as `epochs`: never"""
    authority: Positive = 8.0
    """largest acceleration that it may answer [m/s2]: no network answers what no car can do"""


@checked_dataclass(frozen=True, config=STRICT)
class MultiStepSettings:
    """A network and how it learns, as a residual, from simulated driving."""

    hidden: HiddenSizes = (32, 32)
    """units of the hidden layers"""
    authority: Positive = 2.0
    """largest residual [m/s2]"""
    segment_seconds: Positive = 30.0
    """length of the stretches that are simulated"""
    batch_size: PositiveInt = 64
    """stretches in a gradient step"""
    gradient_steps: PositiveInt = 120
    """gradient steps"""
    learning_rate: Positive = 1e-3
    """learning rate of Adam, which falls to zero as a cosine"""
    speed_weight: NonNegative = 2.0
    """how much an error of the speed by 1 m/s counts beside one of the gap by 1 m"""
    residual_weight: NonNegative = 0.1
    """how much the squared residual counts: where data are silent, the base drives"""
    validation_interval: PositiveInt = 20
    """gradient steps between two judgements on the validation trajectories, which choose the weights"""
