"""Settings of policies and learners, without torch, so that wrong values are reported quickly.

A new learner of the package needs a file with its class, settings here that name this class, and a field of
`AgentSettings`. A learner of the user needs none of them: `agent = "path.py:Class"`.
"""

from dataclasses import field, fields
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field

from unjam.drivers.observation import FeatureName
from unjam.drivers.residual import MAX_AUTHORITY
from unjam.drivers.user_driver import is_file_reference
from unjam.parameters import (
    STRICT,
    IntAboveOne,
    NonNegative,
    NonNegativeInt,
    Options,
    Positive,
    PositiveInt,
    parameter_dataclass,
)

Discount = Annotated[float, Field(gt=0, lt=1)]
UnitInterval = Annotated[float, Field(ge=0, le=1)]


@parameter_dataclass(frozen=True, config=STRICT)
class PolicySettings:
    """The residual network and its exploration."""

    hidden: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (64, 64)
    """units of the hidden layers of the policy and the value network"""
    inputs: Annotated[tuple[FeatureName, ...], Field(min_length=1)] = ("local", "expert_acceleration", "expert_memory")
    """features of the network; the paper uses only `local`, from which the command of PI cannot be predicted"""
    zero_init: bool = True
    """start with a residual of zero, so that the full policy starts as the expert; in the paper the start is random"""
    history_features: bool = False
    """add to the expert's memory the means of own speed, speed deviation, and gap over ten seconds to some minutes"""
    authority: Annotated[float, Field(gt=0, le=MAX_AUTHORITY)] = 1.0
    """largest residual, as a share of the action limit"""
    exploration_std: Positive = 0.1
    """initial standard deviation of the exploration noise, as a share of the action limit"""
    learn_exploration_std: bool = True
    """whether the standard deviation is learned; sac always learns it"""
    exploration: Literal["per_step", "per_episode", "antithetic"] = "per_step"
    """`per_step`: independent noise for each action of a CAV. `per_episode`: one perturbation of the weights of the
    last layer with `exploration_std`, for all CAVs of an episode (trpo and ppo; the standard deviation is not learned;
    after Raffin et al. 2022, CoRL): common actions of many CAVs for minutes change all travel times, while single
    commands vanish in the noise of human drivers. `antithetic`: in pairs of episodes with the same vehicles, the second
    episode has the opposite perturbation (after Salimans et al. 2017, arXiv:1703.03864)"""
    reward_after_exit: bool = False
    """count the rewards after a CAV has left an open road, and give its entry time to the value network: with a shared
    reward, a prevented jam pays off only later. Not with the row model, which has no rewards after an exit"""
    action_duration: NonNegative = 1.0
    """time for which a residual is held [s], rounded to control steps; noise held for a second changes the speed"""
    privileged_critic: bool = True
    """give the drawn values of the episode (the ring's length) to the value network; without them, it takes a large gap
    as a sign of a longer and faster ring, and the policy learns to fall back"""
    max_string_gain: NonNegative = 0.0
    """largest amplification of oscillations of the leader by the full policy, with filter and actuator, at 0.001 to
    1 Hz, on closed roads: updates that exceed it are halved or undone; 0: no limit"""
    normalize_value: bool = True
    """scale the value network by the returns of the first iteration (sac and td3: shift rewards by their mean); from
    zero, it needs tens of iterations to reach values of 150"""

    @property
    def episode_noise(self) -> bool:
        """Whether the exploration noise is drawn once per episode."""
        return self.exploration != "per_step"

    @property
    def exploration_signs(self) -> list[float]:
        """Factors of the exploration noise in consecutive episodes with the same vehicles."""
        return [1.0, -1.0] if self.exploration == "antithetic" else [1.0]

    def action_repeat(self, control_step: float) -> int:
        """Return the number of control steps of `control_step` seconds for which a residual is held."""
        return max(1, round(self.action_duration / control_step))


@parameter_dataclass(frozen=True, config=STRICT)
class LearnerSettings:
    """Settings of every learner."""

    learner_class: ClassVar[str]
    """the learner with these settings, `module:class`"""
    steps_per_iteration: PositiveInt = 12_000
    """environment steps per iteration, rounded up to whole episodes"""
    gamma: Discount = 0.99
    """discount from one action of the network to the next"""


@parameter_dataclass(frozen=True, config=STRICT)
class TRPOSettings(LearnerSettings):
    """Trust region policy optimization; the preset `paper` has the values of Table B5 where these differ."""

    learner_class: ClassVar[str] = "unjam.learners.trpo_ppo:TRPO"
    gae_lambda: UnitInterval = 0.97
    target_kl: Positive = 0.03
    cg_damping: Positive = 0.1
    cg_max_steps: PositiveInt = 15
    critic_epochs: PositiveInt = 10
    critic_batch_size: IntAboveOne = 250
    critic_learning_rate: Positive = 1e-3
    critic_weight_decay: NonNegative = 1e-3


@parameter_dataclass(frozen=True, config=STRICT)
class PPOSettings(LearnerSettings):
    """Proximal policy optimization; the defaults are the values of Table B3, except for larger iterations."""

    learner_class: ClassVar[str] = "unjam.learners.trpo_ppo:PPO"
    gae_lambda: UnitInterval = 0.97
    clip_range: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """largest change of the ratio of new to old probability in an update"""
    epochs: PositiveInt = 80
    minibatches: PositiveInt = 1
    """gradient steps per epoch, each on another part of the iteration's rows; 1: full batches"""
    actor_learning_rate: Positive = 3e-4
    critic_learning_rate: Positive = 1e-3


@parameter_dataclass(frozen=True, config=STRICT)
class OffPolicySettings(LearnerSettings):
    """Settings of off-policy learners, which also learn from rows of earlier iterations."""

    steps_per_iteration: PositiveInt = 6_000
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """soft update coefficient of the target networks"""
    learning_rate: Positive = 3e-4
    reward_scale: Positive = 0.1
    """factor on rewards; the entropy is weighted relative to scaled rewards"""
    batch_size: PositiveInt = 256
    gradient_steps_per_step: Positive = 0.25
    """gradient steps per environment step, including those before learning starts"""
    learning_starts: NonNegativeInt = 10_000
    """environment steps before the first gradient step"""
    start_policy: Literal["expert", "uniform"] = "expert"
    """policy before learning starts: `expert` with noise of `policy.exploration_std`, or `uniform` residuals"""
    real_ratio: UnitInterval = 0.5
    """share of environment rows in a batch, if there are model rows"""
    buffer_size: PositiveInt = 200_000
    """maximum number of rows in the replay buffer, one per action; the oldest are replaced"""


@parameter_dataclass(frozen=True, config=STRICT)
class SACSettings(OffPolicySettings):
    """Soft actor-critic; the preset `paper` has the values of Table B4 where these differ."""

    learner_class: ClassVar[str] = "unjam.learners.sac_td3:SAC"
    temperature: Positive = 0.05
    """weight of the policy's entropy, in units of scaled rewards; with the paper's 0.2 the noise alone costs a quarter
    of the return on the ring, and the learned policy fails on short rings"""
    learn_temperature: bool = False
    """whether the temperature is adapted, starting from `temperature`, so that the entropy becomes `target_entropy`"""
    target_entropy: Annotated[float, Field(lt=0.69)] = -1.0
    """entropy of the residual as a share of its authority; noise with a standard deviation of 0.09 has -1"""


@parameter_dataclass(frozen=True, config=STRICT)
class TD3Settings(OffPolicySettings):
    """Twin delayed deep deterministic policy gradient; most defaults are those of Fujimoto et al. 2018."""

    learner_class: ClassVar[str] = "unjam.learners.sac_td3:TD3"
    learning_rate: Positive = 1e-3
    policy_delay: PositiveInt = 2
    """gradient steps of the critics per update of the policy and the target networks"""
    target_noise: NonNegative = 0.2
    """standard deviation of the target policy's smoothing noise, as a share of the authority"""
    target_noise_clip: NonNegative = 0.5
    """largest smoothing noise, as a share of the authority"""


@parameter_dataclass(frozen=True, config=STRICT)
class UserAgentSettings(LearnerSettings):
    """Settings of an agent of the user."""

    options: Options = field(default_factory=dict)
    """keyword arguments of the agent's class"""


AGENT_NAMES = ("trpo", "ppo", "sac", "td3")
"""the learners of the package"""


def _check_agent_name(name: str) -> str:
    if name not in AGENT_NAMES and not is_file_reference(name):
        raise ValueError(f"{', '.join(map(repr, AGENT_NAMES))} or 'path.py:Class'")
    return name


AgentName = Annotated[str, AfterValidator(_check_agent_name)]
"""one of `AGENT_NAMES`, or `path.py:Class`"""


def unused_tables(agent: str) -> tuple[str, ...]:
    """Return the tables that must be empty with an agent; with a learner of the package, only `user` must be."""
    return ("user",) if agent in AGENT_NAMES else AGENT_NAMES


@parameter_dataclass(frozen=True, config=STRICT)
class AgentSettings:
    """The chosen agent, and a table of settings for each learner."""

    agent: AgentName = "trpo"
    """name of a learner of the package, or `path.py:Class`: a learner or an algorithm of the user"""
    trpo: TRPOSettings = field(default_factory=TRPOSettings)
    ppo: PPOSettings = field(default_factory=PPOSettings)
    sac: SACSettings = field(default_factory=SACSettings)
    td3: TD3Settings = field(default_factory=TD3Settings)
    user: UserAgentSettings = field(default_factory=UserAgentSettings)

    @property
    def learner(self) -> LearnerSettings:
        """The settings of the chosen agent."""
        return getattr(self, self.agent if self.agent in AGENT_NAMES else "user")

    @property
    def unused_setting(self) -> str:
        """A setting without effect that differs from its default, with its value; empty: none."""
        for table in unused_tables(self.agent):
            settings = getattr(self, table)
            for name in (setting.name for setting in fields(settings)):
                value = getattr(settings, name)
                if value != getattr(type(settings)(), name):
                    return f"{table}.{name}: {value!r}"
        return ""
