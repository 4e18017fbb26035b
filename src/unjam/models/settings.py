"""What decides how the virtual environment learns and how far it is trusted. Free of torch."""

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, IntAboveOne, NonNegative, NonNegativeInt, Positive, PositiveInt

BaseName = Literal["idm", "population", "acc", "ovm", "none"]
Device = Literal["cpu", "cuda"]
ErrorEstimator = Literal["unexplained_variance", "transitions", "total_variation", "training_loss"]


@dataclass(frozen=True, config=STRICT)
class ModelSettings:
    """The virtual environment: its model, how it is fitted, and the length of its rollouts."""

    kind: Literal["row", "road"] = "row"
    """what is imagined: the row of a CAV, its leader and its follower, as in the paper; or, on rings,
    figures eight and on-ramps, whole roads, each of whose people drives by the base and by what all of them
    have taught one ensemble"""
    base: BaseName = "idm"
    """what is known before learning: how the follower drives; `population`: as the typical driver of the
    road's calibrated population, residual included; `none`: nothing, all is learned"""
    calibrate_base: bool = False
    """whether the base takes IDM parameters that are calibrated, in the first iteration, on those who drove
    behind the CAVs; otherwise it knows those of the road"""
    members: PositiveInt = 5
    """networks in the ensemble"""
    hidden: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (64, 64)
    """units of the hidden layers of each network"""
    fallback_to_base: bool = True
    """whether the networks begin by adding nothing to the base, which stands alone where they are worse on
    the holdout; the paper's begin as they are drawn, and are always added"""
    buffer_size: PositiveInt = 100_000
    """actual decisions that are kept, the newest, rounded up to whole episodes"""
    max_fit_rows: IntAboveOne = 10_000
    """at most so many of them are drawn for each fit: neighbouring rows, 0.1 s apart, hardly differ"""
    holdout: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """share of the episodes that no network learns from; while there is a single one, its last part"""
    epochs: PositiveInt = 6
    """most passes over the rows in a fit, which goes on from the fit before"""
    patience: PositiveInt = 3
    """passes without progress on the holdout after which a fit ends"""
    learning_rate: Positive = 3e-3
    """learning rate of Adam"""
    batch_size: PositiveInt = 512
    """rows of each network in a gradient step"""
    add_noise: bool = True
    """whether virtual steps are as noisy as the model's errors on the holdout, or the mean of each network"""
    k_max: NonNegativeInt = 500
    """longest rollout [decisions]"""
    kappa: Positive = 100.0
    """rollout length times model error, Eq. 15. The paper has 2; but on a road with noisy people most of the
    error that is measured is their noise, and virtual returns agree with actual ones over hundreds of
    decisions"""
    error_estimator: ErrorEstimator = "unexplained_variance"
    """estimator of the model error eps_m that sets the rollout length, see unjam.models.fitting"""
    model_ratio: NonNegative = 5.0
    """virtual decisions for each actual one that the agent learns from, at least one whole rollout in each
    iteration; 0: model-free"""
    rollout_starts: Literal["newest", "all", "first"] = "newest"
    """at which actual decisions rollouts begin: those of the newest policy's episodes; of all episodes that
    are kept, whose roads are more various; or the first ones of all, so that what is imagined are episodes"""
    update_mode: Literal["union", "sequential"] = "union"
    """how the agent learns from both: from all of them at once; or first from the actual ones, then `model_updates`
    times from virtual ones alone, each time with those of the newest policy, as the released code"""
    model_updates: PositiveInt = 5
    """updates on virtual rows of `sequential`"""
    device: Device = "cpu"
    """where the virtual environment runs"""

    @model_validator(mode="after")
    def _check_estimator(self) -> "ModelSettings":
        if self.error_estimator == "total_variation" and self.members < 2:
            raise ValueError(f"members: {self.members} is not allowed with total_variation; allowed: >= 2")
        return self
