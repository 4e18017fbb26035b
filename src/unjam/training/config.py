"""Everything that decides what a training run does: one validated configuration, as TOML and flags."""

import tomllib
from dataclasses import asdict, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import Field, field_validator, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.constant import Constant
from unjam.drivers.driver import Driver
from unjam.errors import InputError
from unjam.learners.settings import LearnerSettings, PolicySettings, PPOSettings, SACSettings, TRPOSettings
from unjam.parameters import STRICT, Count, CountOrNone, build, merge, nested
from unjam.scenarios.registry import make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.training.presets import preset_values
from unjam.virtual.settings import VirtualSettings


@dataclass(frozen=True, config=STRICT)
class EvaluationSettings:
    """How a run is judged, always with the deterministic policy; its steps are counted apart."""

    every: CountOrNone = 5
    """iterations between two validations; 0: none, and the last policy becomes the controller"""
    validation_episodes: Count = 4
    """episodes of a validation, the same seeds each time: they choose the controller"""
    episodes: Count = 20
    """episodes of the final evaluation, on held-out seeds that chose nothing"""
    baselines: tuple[str, ...] = ("human", "pi", "follower-stopper")
    """drivers that are evaluated beside the expert and the trained controller"""


@dataclass(frozen=True, config=STRICT)
class RunConfig:
    """One training run. Every key can be set in a TOML file, by `--set key=value`, and in Python."""

    scenario: str = "ring"
    road: dict[str, Any] = field(default_factory=dict)
    """changes to the scenario's parameters"""
    agent: Literal["trpo", "ppo", "sac"] = "trpo"
    """who learns; its settings are in the table of its name"""
    expert: str = "pi"
    """driver that the residual is added to: a name, `path.py:name`, a run folder, a .unjam file; `none`:
    the network drives alone"""
    reward: str = ""
    """a name or `path.py:name`; empty: the scenario's own"""
    steps: Count = 960_000
    """actual steps of training"""
    seed: Annotated[int, Field(ge=0, lt=1_000_000)] = 0
    """of the whole run; numbers from a million on are those of the episodes that judge"""
    workers: Count = 2
    spread: bool = True
    """whether the episodes of an iteration, and of a validation, cover the range of what they draw (the
    ring's lengths) evenly"""
    policy: PolicySettings = field(default_factory=PolicySettings)
    trpo: TRPOSettings = field(default_factory=TRPOSettings)
    ppo: PPOSettings = field(default_factory=PPOSettings)
    sac: SACSettings = field(default_factory=SACSettings)
    virtual: VirtualSettings = field(default_factory=VirtualSettings)
    """the virtual environment, in which the agent learns between actual episodes"""
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    preset: str = ""
    """which preset this started from, for the record"""

    @field_validator("road")
    @classmethod
    def _plain(cls, road: dict[str, Any]) -> dict[str, Any]:
        """Return the changes as a TOML file gives them back, so that a run knows its own road again."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in road.items()}

    @model_validator(mode="after")
    def _possible(self) -> "RunConfig":
        self.make_scenario()
        return self

    @property
    def learner(self) -> LearnerSettings:
        """The settings of the learner that was chosen."""
        return getattr(self, self.agent)

    def make_scenario(self) -> Scenario:
        """Return the scenario with its changes."""
        try:
            return make_scenario(self.scenario, self.road)
        except InputError as error:
            raise ValueError(str(error)) from None

    def make_expert(self) -> Driver:
        """Return the driver that the residual is added to."""
        from unjam.controller import make_driver

        if self.expert == "none":
            return Constant()
        return make_driver(self.expert, self.make_scenario().decision_step)


def load_config(
    file: Path | None = None, preset: str = "", changes: dict[str, Any] | None = None
) -> RunConfig:
    """Return a configuration: the defaults, changed by a preset, by a TOML file, by `changes`, in this order.

    Keys of `changes` may have dots: `trpo.gamma`.

    Raises:
        InputError: an unknown key or preset, a value out of range, an unreadable file.
    """
    given = merge(read_toml(file) if file is not None else {}, nested(changes or {}))
    values: dict[str, Any] = {}
    if preset:
        started = preset_values(preset, str(given.get("scenario", RunConfig.scenario)))
        values = {**started, "preset": preset}
    return build(RunConfig, merge(values, given), "")


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; raise `InputError` where it is missing or not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"config file {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"config file {path}: not TOML: {error}") from None


def to_toml(config: RunConfig) -> str:
    """Return a configuration as TOML, every key written out."""
    return tomli_w.dumps(asdict(config))
