"""What decides how an agent learns. Free of torch, so that a wrong value is refused at once.

A learner is a file that makes it, and here its settings, which name it, and their place in `AgentSettings`.
"""

from dataclasses import field
from typing import Annotated, ClassVar, Literal, get_args

from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.observation import FeatureName
from unjam.parameters import STRICT, IntAboveOne, NonNegative, NonNegativeInt, Positive, PositiveInt

Discount = Annotated[float, Field(gt=0, lt=1)]
UnitInterval = Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True, config=STRICT)
class PolicySettings:
    """The residual network and how it explores."""

    hidden: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (64, 64)
    """units of the hidden layers, of the policy and of the value network"""
    inputs: Annotated[tuple[FeatureName, ...], Field(min_length=1)] = ("local", "expert_acceleration", "expert_memory")
    """what the network sees; the paper's network sees `local` alone, and cannot know what PI will do"""
    zero_init: bool = True
    """whether the untrained network adds nothing, so that the full policy begins as exactly the expert, or
    what its random weights happen to answer, as the paper's"""
    history_features: bool = False
    """whether what the network sees of the expert's memory has means of the own past besides: speed, its
    spread, and gap, over ten seconds to some minutes"""
    authority: Positive = 1.0
    """largest residual, as a share of the action limit"""
    exploration_std: Positive = 0.1
    """standard deviation of the exploration noise at the start, as a share of the action limit"""
    learn_exploration_std: bool = True
    """whether the standard deviation is learned, or stays what it is at the start (sac always learns it)"""
    exploration: Literal["per_step", "per_episode", "antithetic"] = "per_step"
    """`anew`: noise for each look of a CAV. `episode_noise`: one change of what the last hidden layer is weighed
    with, of which `exploration_std` is that of each weight, for all CAVs all episode long: what many do for
    minutes shows in what everybody gains, where single commands vanish in people's noise (trpo and ppo; it
    is not learned; after Raffin et al. 2022, CoRL). `mirrored`: likewise, and each episode has another of the
    same people in which the change is opposite (after Salimans et al. 2017, arXiv:1703.03864)"""
    reward_after_exit: bool = False
    """whether a CAV also earns what is earned once it has left a road with ends, and the value network sees
    when it came: where all earn the same, a jam that it has prevented shows when it is gone. Not where
    rows are imagined, whose moments do not know what follows"""
    action_duration: NonNegative = 1.0
    """how long one residual is held [s], rounded to whole decisions, at least one: over a second noise adds
    up to a change of speed instead of cancelling itself"""
    privileged_critic: bool = True
    """whether the value network also sees what the episode has drawn (the ring's length); without it, it
    takes a large gap for a longer and faster ring, and the policy learns to fall back"""
    normalize_value: bool = True
    """scale the value network by the returns of the first iteration (sac: shift by its mean reward): one that
    starts at zero needs tens of iterations to reach values of 150"""

    @property
    def episode_noise(self) -> bool:
        """Whether exploration stays as it is all episode long."""
        return self.exploration != "per_step"

    @property
    def exploration_signs(self) -> list[float]:
        """By how much exploration counts in episodes that are alike but for that."""
        return [1.0, -1.0] if self.exploration == "antithetic" else [1.0]

    def action_repeat(self, control_step: float) -> int:
        """Return for how many decisions a residual is held where one takes `control_step` seconds."""
        return max(1, round(self.action_duration / control_step))


@dataclass(frozen=True, config=STRICT)
class LearnerSettings:
    """What every learner has."""

    learner_class: ClassVar[str]
    """who is made of them: `module:class`"""
    steps_per_iteration: PositiveInt = 12_000
    """actual steps in an iteration, rounded up to whole episodes"""
    gamma: Discount = 0.99
    """discount from one choice of the network to the next"""


@dataclass(frozen=True, config=STRICT)
class TRPOSettings(LearnerSettings):
    """Trust region policy optimisation; the preset `paper` has the values of Table B5 where these differ."""

    learner_class: ClassVar[str] = "unjam.learners.trpo_ppo:TRPO"
    gae_lambda: UnitInterval = 0.97
    target_kl: Positive = 0.03
    cg_damping: Positive = 0.1
    cg_max_steps: PositiveInt = 15
    critic_epochs: PositiveInt = 10
    critic_batch_size: IntAboveOne = 250
    critic_learning_rate: Positive = 1e-3
    critic_weight_decay: NonNegative = 1e-3


@dataclass(frozen=True, config=STRICT)
class PPOSettings(LearnerSettings):
    """Proximal policy optimisation; its defaults are the values of Table B3, but for larger iterations."""

    learner_class: ClassVar[str] = "unjam.learners.trpo_ppo:PPO"
    gae_lambda: UnitInterval = 0.97
    clip_range: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """how far the ratio of new to old probability may move an update"""
    epochs: PositiveInt = 80
    minibatches: PositiveInt = 1
    """parts of an iteration's rows, each a gradient step in each epoch; 1: full batches"""
    actor_learning_rate: Positive = 3e-4
    critic_learning_rate: Positive = 1e-3


@dataclass(frozen=True, config=STRICT)
class OffPolicySettings(LearnerSettings):
    """What learners share that learn from earlier iterations too."""

    steps_per_iteration: PositiveInt = 6_000
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """share by which the target networks move towards the learned ones in a gradient step"""
    learning_rate: Positive = 3e-4
    reward_scale: Positive = 0.1
    """factor of what is earned from one choice to the next: the temperature is weighed against it"""
    batch_size: PositiveInt = 256
    gradient_steps_per_step: Positive = 0.25
    """gradient steps per actual step, those of the start included"""
    learning_starts: NonNegativeInt = 10_000
    """actual steps before the first gradient step"""
    start_policy: Literal["expert", "uniform"] = "expert"
    """how these are driven: `expert`, with the little noise of `policy.exploration_std`; `uniform` residuals
    over the whole authority"""
    real_ratio: UnitInterval = 0.5
    """share of actual rows in a batch, where there are virtual ones"""
    buffer_size: PositiveInt = 200_000
    """newest rows, one per choice, that are learned from"""


@dataclass(frozen=True, config=STRICT)
class SACSettings(OffPolicySettings):
    """Soft actor-critic; the preset `paper` has the values of Table B4 where these differ."""

    learner_class: ClassVar[str] = "unjam.learners.sac:SAC"
    temperature: Positive = 0.05
    """weight of the policy's entropy, in units of scaled rewards; with the paper's 0.2 the noise alone costs
    a quarter of the return on the ring, and what is learned from such driving fails on short rings"""
    learn_temperature: bool = False
    """whether the temperature is learned, from its start on, so that the entropy becomes `target_entropy`"""
    target_entropy: Annotated[float, Field(lt=0.69)] = -1.0
    """of the residual as a share of its authority: -1 is that of noise with a standard deviation of 0.09"""


@dataclass(frozen=True, config=STRICT)
class TD3Settings(OffPolicySettings):
    """Twin delayed deep deterministic policy gradient; the values of Fujimoto et al. 2018 where they fit."""

    learner_class: ClassVar[str] = "unjam.learners.td3:TD3"
    learning_rate: Positive = 1e-3
    policy_delay: PositiveInt = 2
    """gradient steps of the critics for one of the policy and of the target networks"""
    target_noise: NonNegative = 0.2
    """standard deviation of the noise that smooths the target policy, as a share of the authority"""
    target_noise_clip: NonNegative = 0.5
    """largest such noise, as a share of the authority"""


AgentName = Literal["trpo", "ppo", "sac", "td3"]
AGENT_NAMES: tuple[AgentName, ...] = get_args(AgentName)


@dataclass(frozen=True, config=STRICT)
class AgentSettings:
    """Who learns, and the settings of every learner in the table of its name."""

    agent: AgentName = "trpo"
    """who learns; its settings are in the table of its name"""
    trpo: TRPOSettings = field(default_factory=TRPOSettings)
    ppo: PPOSettings = field(default_factory=PPOSettings)
    sac: SACSettings = field(default_factory=SACSettings)
    td3: TD3Settings = field(default_factory=TD3Settings)

    @property
    def learner(self) -> LearnerSettings:
        """The settings of the learner that was chosen."""
        return getattr(self, self.agent)
