"""Settings of the learned model, of its fit and of its rollouts. This module does not import torch."""

from dataclasses import field
from typing import Annotated, Literal

from pydantic import Field, model_validator

from unjam.parameters import (
    STRICT,
    IntAboveOne,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    parameter_dataclass,
)

BaseName = Literal["idm", "population", "acc", "ovm", "none"]
IDMName = Literal[
    "desired_speed", "time_headway", "max_acceleration", "comfortable_deceleration", "exponent", "minimum_gap"
]
Device = Literal["cpu", "cuda"]
ErrorEstimator = Literal["unexplained_variance", "transitions", "total_variation", "training_loss"]


@parameter_dataclass(frozen=True, config=STRICT)
class ModelSettings:
    """The learned model (the paper's virtual environment), its fit, and the length of its rollouts."""

    kind: Literal["row", "road"] = "row"
    """`row`: a CAV, its leader and its follower, as in the paper; `road`: whole rings, figure eights or motorways, on
    which all human drivers follow the base plus the residual of one ensemble"""
    base: BaseName = "idm"
    """known model of human drivers that the networks correct; `population`: the typical driver of the road's
    calibrated population, with its residual; `none`: networks learn all changes"""
    calibrate_base: bool = False
    """whether the IDM of the base is calibrated in the first iteration with the followers of CAVs; otherwise it has the
    parameters of the road"""
    humans: dict[IDMName, Positive] = field(default_factory=dict)
    """IDM parameters of the base that differ from those of the road, to study inexact knowledge of drivers"""
    members: PositiveInt = 5
    """number of networks in the ensemble"""
    hidden: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (64, 64)
    """number of units of each hidden layer of a network"""
    fallback_to_base: bool = True
    """whether networks start at zero, and only correct quantities that they predict better than the base on the
    holdout; in the paper networks start at random and are always used"""
    buffer_size: PositiveInt = 100_000
    """number of stored environment steps, the newest ones, rounded up to whole episodes"""
    max_fit_rows: IntAboveOne = 10_000
    """maximum number of rows of a fit, drawn at random; rows that are 0.1 s apart hardly differ"""
    holdout: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """share of the episodes that are not used for training, but for validation; of a single episode, its last part"""
    epochs: PositiveInt = 6
    """maximum number of epochs of a fit, which continues from the previous fit"""
    patience: PositiveInt = 3
    """number of epochs without improvement on the holdout after which a fit stops"""
    learning_rate: Positive = 3e-3
    """learning rate of Adam"""
    batch_size: PositiveInt = 512
    """number of rows per network in a gradient step"""
    add_noise: bool = True
    """whether noise with the size of the model's errors on the holdout is added in each model step"""
    k_max: NonNegativeInt = 500
    """maximum rollout length [control steps]"""
    kappa: Positive = 100.0
    """rollout length times model error, Eq. 15. The paper uses 2; but most of the measured error is noise of human
    drivers, and model returns agree with environment returns over hundreds of steps"""
    error_estimator: ErrorEstimator = "unexplained_variance"
    """estimator of the model error eps_m that sets the rollout length, see `unjam.models.ensemble.ModelFit`"""
    model_ratio: NonNegative = 5.0
    """number of model steps per environment step, with at least one rollout in each iteration; 0: model-free"""
    rollout_starts: Literal["newest", "all", "first"] = "newest"
    """recorded states from which rollouts start: `newest`: random steps of episodes of the newest policy; `all`: random
    steps of all stored episodes, with more diverse roads; `first`: first steps, so that rollouts are episodes"""
    update_mode: Literal["union", "sequential"] = "union"
    """`union`: one policy update on environment and model rows; `sequential`: one on environment rows, then
    `model_updates` on model rows, each with rollouts of the newest policy, as in the authors' code"""
    model_updates: PositiveInt = 5
    """number of policy updates on model rows with `sequential`"""
    device: Device = "cpu"
    """device of the model and its rollouts"""

    @model_validator(mode="after")
    def _check_base_and_estimator(self) -> "ModelSettings":
        if self.humans and self.base != "idm":
            raise ValueError(f"humans: IDM parameters are not allowed with base {self.base!r}; allowed: base 'idm'")
        if self.error_estimator == "total_variation" and self.members < 2:
            raise ValueError(f"members: {self.members} is not allowed with total_variation; allowed: >= 2")
        return self
