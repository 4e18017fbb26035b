"""Settings of networks that learn to follow, without torch, which the calibration of populations does not need."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt

HiddenSizes = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]


@checked_dataclass(frozen=True, config=STRICT)
class NetworkSettings:
    """A network that learns single accelerations; the defaults are those of the paper."""

    hidden: HiddenSizes = (128, 128)
    """sizes of the hidden layers"""
    learning_rate: Positive = 1e-4
    """of Adam"""
    batch_size: PositiveInt = 1024
    epochs: PositiveInt = 200
    """maximum number"""
    patience: PositiveInt = 200
    """epochs without improvement in validation after which learning ends; as many as `epochs`: never"""
    authority: Positive = 8.0
    """largest acceleration, which cars can reach [m/s2]"""


@checked_dataclass(frozen=True, config=STRICT)
class MultiStepSettings:
    """A network that learns a residual from simulated driving."""

    hidden: HiddenSizes = (32, 32)
    """sizes of the hidden layers"""
    authority: Positive = 2.0
    """largest residual [m/s2]"""
    segment_seconds: Positive = 30.0
    """duration of the simulated segments [s]"""
    batch_size: PositiveInt = 64
    """segments in a gradient step"""
    gradient_steps: PositiveInt = 120
    learning_rate: Positive = 1e-3
    """initial learning rate of Adam, which falls to zero as a cosine"""
    speed_weight: NonNegative = 2.0
    """weight of a speed error of 1 m/s relative to a gap error of 1 m"""
    residual_weight: NonNegative = 0.1
    """weight of the squared residual, so that the base drives where there are no data"""
    validation_interval: PositiveInt = 20
    """gradient steps between two validations, which select the weights"""
