"""Settings of the learned model: how it is fitted, and how long its rollouts are. Free of torch."""

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
    """`row`: a CAV, its leader and its follower, as in the paper; `road`: whole rings, figures eight or on-ramps,
    on which each human driver follows the base plus one learned ensemble"""
    base: BaseName = "idm"
    """known model of human drivers, which the networks correct; `population`: the typical driver of the road's
    calibrated population, with its residual; `none`: everything is learned"""
    calibrate_base: bool = False
    """calibrate the IDM of the base in the first iteration on the followers of CAVs; else the road's parameters"""
    humans: dict[IDMName, Positive] = field(default_factory=dict)
    """IDM parameters of the base that differ from the road's, as where drivers are not known exactly"""
    members: PositiveInt = 5
    """networks in the ensemble"""
    hidden: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (64, 64)
    """units of the hidden layers of each network"""
    fallback_to_base: bool = True
    """start networks at zero, use the base where it is better on the holdout; the paper adds random ones in any case"""
    buffer_size: PositiveInt = 100_000
    """newest environment steps that are stored, rounded up to whole episodes"""
    max_fit_rows: IntAboveOne = 10_000
    """rows drawn from them for each fit; rows that are 0.1 s apart hardly differ"""
    holdout: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """share of the episodes that no network is trained on; of a single episode, its last part"""
    epochs: PositiveInt = 6
    """maximum number of epochs of a fit, which continues from the previous fit"""
    patience: PositiveInt = 3
    """epochs without improvement on the holdout after which a fit stops"""
    learning_rate: Positive = 3e-3
    """learning rate of Adam"""
    batch_size: PositiveInt = 512
    """rows per network in a gradient step"""
    add_noise: bool = True
    """add noise as large as the model's errors on the holdout to each model step; else the mean of each network"""
    k_max: NonNegativeInt = 500
    """maximum rollout length [control steps]"""
    kappa: Positive = 100.0
    """rollout length times model error, Eq. 15. The paper uses 2; with noisy human drivers most of the measured error
    is their noise, and model returns agree with environment returns over hundreds of steps"""
    error_estimator: ErrorEstimator = "unexplained_variance"
    """estimator of the model error eps_m that sets the rollout length, see `unjam.models.ensemble.ModelFit`"""
    model_ratio: NonNegative = 5.0
    """model steps per environment step, at least one rollout in each iteration; 0: model-free"""
    rollout_starts: Literal["newest", "all", "first"] = "newest"
    """where rollouts start: at random steps of the newest policy's episodes, of all stored episodes (more diverse
    roads), or at first steps of episodes, so that rollouts are episodes"""
    update_mode: Literal["union", "sequential"] = "union"
    """`union`: one update on environment and model rows; `sequential`: one on environment rows, then `model_updates` on
    model rows alone, each with rollouts of the newest policy, as in the authors' code"""
    model_updates: PositiveInt = 5
    """updates on model rows of `sequential`"""
    device: Device = "cpu"
    """device of the model and its rollouts"""

    @model_validator(mode="after")
    def _check_base_and_estimator(self) -> "ModelSettings":
        if self.humans and self.base != "idm":
            raise ValueError("IDM parameters of humans only with the base 'idm'")
        if self.error_estimator == "total_variation" and self.members < 2:
            raise ValueError(f"members: {self.members} is not allowed with total_variation; allowed: >= 2")
        return self
