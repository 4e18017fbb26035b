"""What Algorithm 1 does between actual episodes: fit the virtual environment, and imagine in it."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from math import ceil
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.drivers.network import Network
from unjam.drivers.residual import ResidualDriver
from unjam.following.calibration import calibrated_people
from unjam.learners.experience import Experience
from unjam.learners.learner import under
from unjam.learners.settings import PolicySettings
from unjam.learners.waves import Waves
from unjam.physics.idm import IDMParameters
from unjam.tree import pack, unpack
from unjam.virtual.comparison import return_gap
from unjam.virtual.data import ActualData, is_held_out, pack_data, unpack_data
from unjam.virtual.ensemble import Ensemble, torch_generator
from unjam.virtual.fitting import Fit, fit
from unjam.virtual.model import EnvironmentModel
from unjam.virtual.roads import RoadModel
from unjam.virtual.rollout import Rollouts, begin, draw_starts, imagine, return_bound, rollout_length
from unjam.virtual.settings import VirtualSettings
from unjam.virtual.world import VirtualDynamics, check_is_there
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Floats
from unjam.worlds.workers import EpisodeTask

FIT, STARTS, NOISE, EXPLORATION = 2, 3, 4, 5
"""what the random numbers of an iteration are for, in their seeds"""
DATA, MOMENTS = "data/", "moments/"
"""prefixes of tensors in checkpoints"""


class AsExperience(NamedTuple):
    """How what was imagined becomes what a learner takes."""

    seen_by_critic: Callable[[Floats], Floats]
    """from what episodes drew, shape (rows, m), to what the critic alone sees of it"""
    of_episodes: Callable[[Sequence[Episode]], Experience]
    """of whole episodes, as of actual ones"""


def full_policy(task: Task, policy: PolicySettings, network: Network) -> ResidualDriver:
    """Return the full policy on a task: its expert plus the residual of `network`."""
    hold = policy.decisions_held(task.scenario.decision_step)
    return ResidualDriver(task.expert, network, task.scenario.action_limit, policy.observe, hold)


Model = TypeVar("Model", bound=Ensemble)


class Imagination(Generic[Model]):
    """The virtual environment of a run, and the actual data that it learns from.

    What kind of environment it is, its heirs say: what is learned, and how one drives in it.
    """

    def __init__(
        self, settings: VirtualSettings, task: Task, policy: PolicySettings, run_seed: int, index: int = 0
    ) -> None:
        """Begin with physics alone, and without data; `index` is the task's place in its training.

        Raises:
            MissingPartError: the device that the settings name is not there.
        """
        check_is_there(settings.device, "virtual.device")
        self.settings = settings
        self.name = f"virtual-{index}" if index else "virtual"
        """in checkpoints"""
        self.data = ActualData(settings.rows)
        self.scenario = task.scenario
        """the road as far as it is known: with calibrated people where the settings ask for them"""
        self._task = task
        self._policy = policy
        self._run_seed = run_seed
        self._index = (index,) if index else ()
        self.model = self._new_model()
        self.steps = 0
        """virtual decisions of all iterations so far"""
        self.facts: dict[str, Any] = {}
        """what there is to say of the virtual environment in this iteration"""

    def _new_model(self) -> Model:
        """Return a model that has learned nothing."""
        raise NotImplementedError

    def _fit(self, seed: Sequence[int]) -> Fit:
        """Fit the model to D_a as it is now."""
        raise NotImplementedError

    def imagine(
        self, network: Network, iteration: int, part: int, parts: int, how: AsExperience
    ) -> Experience | None:
        """Return what the policy `network` does in the virtual environment; None where it is not trusted.

        Rollouts begin at random decisions at which a residual was due, `begin` says of which episodes. In all
        `parts` of an iteration together they make `virtual_ratio` times as many decisions as the newest
        actual episodes have.
        """
        raise NotImplementedError

    def _seed(self, *of: int) -> tuple[int, ...]:
        """Return a seed of the run's, the task's own."""
        return (self._run_seed, *of, *self._index)

    def learn(self, episodes: Sequence[Episode], iteration: int) -> None:
        """Add actual episodes to D_a, fit the model to it, and find the rollout length of Eq. 15."""
        first = self.data.episodes
        self.data.add(episodes, self.scenario)
        driven = (len(each.reward) for episode in episodes for each in episode.trajectories)
        self._first, self._actual = first, sum(driven)
        settings = self.settings
        if settings.calibrate and first == 0:
            states = (kept.states for kept in self.data.recordings)
            self.scenario = replace(self.scenario, humans=calibrated_people(states, self.scenario))
        found = self._fit(self._seed(iteration, FIT))
        eps_m = found.errors[settings.error]
        self.k_star = rollout_length(eps_m, settings)
        self.facts = {
            "k_star": self.k_star,
            "eps_m": eps_m,
            "eps_m_by_estimator": found.errors,
            "one_step": {name: error._asdict() for name, error in found.one_step.items()},
            "learned": list(found.learned),
            "epochs": found.epochs,
        }

    def _starts(self, parts: int, seed: tuple[int, ...], driven: int) -> NDArray[np.int64]:
        """Return where a part of an iteration's rollouts of so many decisions begin, as `draw_starts`."""
        count = ceil(self.settings.virtual_ratio * self._actual / parts / driven)
        begin = self.settings.begin
        since = self._first if begin == "newest" else 0
        return draw_starts(self.data, count, 1, seed, since, at_first=begin == "first")

    def _compare(self, earned: Floats, starts: NDArray[np.int64], driven: int, crashed: float) -> None:
        """Note what the policy that drove the actual episodes earned here and there, and its crashes."""
        newest = [self.data.recordings[place].episode >= self._first for place in starts[:, 0]]
        gap = return_gap(earned[newest], starts[newest], self.data, driven)
        self.facts |= {
            "return_virtual": gap and gap.virtual,
            "return_actual": gap and gap.actual,
            "crash_share": crashed,
        }

    def bound(self, eps_pi: float, gamma: float) -> float:
        """Return the bound C for this iteration; `gamma` is that from choice to choice."""
        return self.bound_at(self.k_star, eps_pi, self.facts["eps_m_by_estimator"]["transitions"], gamma)

    def bound_at(self, k: int, eps_pi: float, eps_m: float, gamma: float) -> float:
        """Return the bound C with rollouts of `k` decisions; `gamma` is that from choice to choice."""
        return return_bound(eps_pi, eps_m, k, self.decision_discount(gamma), self.largest_reward)

    @property
    def largest_reward(self) -> float:
        """R_max: the largest |reward| of a decision in the actual data."""
        return max(float(np.abs(kept.reward).max()) for kept in self.data.recordings)

    def decision_discount(self, gamma: float) -> float:
        """Return the discount from decision to decision; `gamma` is that from choice to choice."""
        return gamma ** (1 / self._policy.decisions_held(self.scenario.decision_step))

    def state(self) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
        """Return all that a run must keep of it to go on, as JSON and tensors."""
        facts, arrays = pack_data(self.data)
        tensors = {f"{DATA}{name}": torch.from_numpy(np.array(array)) for name, array in arrays.items()}
        tensors |= {name: tensor.cpu() for name, tensor in self.model.state_dict().items()}
        return {"steps": self.steps, "data": facts, "people": asdict(self.scenario.humans)}, tensors

    def restore(self, facts: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        """Go on from what `state` returned."""
        arrays = {name: tensor.numpy() for name, tensor in under(DATA, tensors).items()}
        self.data = unpack_data(facts["data"], arrays)
        self.steps = facts["steps"]
        self.scenario = replace(self.scenario, humans=IDMParameters(**facts["people"]))
        self.model.load_state_dict({n: t for n, t in tensors.items() if not n.startswith(DATA)})


class OfAnEpisode(Protocol):
    """What is kept of an actual episode."""

    @property
    def episode(self) -> int:
        """Number of the episode."""
        ...


Kept = TypeVar("Kept", bound=OfAnEpisode)


class WholeRoads(Imagination[RoadModel], Generic[Kept]):
    """The virtual environment of a run as whole roads, of which more is kept than what CAVs perceived."""

    kind: type[Kept]
    """of what is kept of each episode"""

    def __init__(self, *arguments: Any) -> None:
        """Begin with the base alone, and without data; arguments are those of `Imagination`."""
        super().__init__(*arguments)
        self.moments: list[Kept] = []
        """of the episodes in D_a, oldest first"""

    def _new_model(self) -> RoadModel:
        return RoadModel(self.settings, self._seed(FIT))

    def _kept_of(self, episode: Episode, number: int) -> Kept:
        """Return what is kept of an actual episode, the so many-th."""
        raise NotImplementedError

    def _fit_moments(self, seed: Sequence[int]) -> Fit:
        """Fit the model to what is kept of D_a as it is now."""
        raise NotImplementedError

    def waves(self, drive: Callable[[EpisodeTask], Episode]) -> Waves:
        """Return a road as it was and as it is imagined; `drive` runs an episode where actual ones run."""
        raise NotImplementedError

    @property
    def _unseen(self) -> Kept:
        """The newest episode that no network learned from, if there is one."""
        share, twins = self.settings.holdout, self._twins
        unseen = [each for each in self.moments if is_held_out(each.episode // twins, share)]
        return (unseen or self.moments)[-1]

    @property
    def _twins(self) -> int:
        """How many episodes in a row meet the same people: they are held out together."""
        return len(self._policy.explores)

    def learn(self, episodes: Sequence[Episode], iteration: int) -> None:
        """Add actual episodes to D_a, fit the model to it, and find the rollout length of Eq. 15."""
        first = self.data.episodes
        self.moments += [self._kept_of(episode, first + place) for place, episode in enumerate(episodes)]
        super().learn(episodes, iteration)

    def _fit(self, seed: Sequence[int]) -> Fit:
        oldest = self.data.recordings[0].episode
        self.moments = [kept for kept in self.moments if kept.episode >= oldest]
        return self._fit_moments(seed)

    def state(self) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
        """Return all that a run must keep of it to go on, as JSON and tensors."""
        facts, tensors = super().state()
        kept, arrays = pack(self.moments)
        tensors |= {f"{MOMENTS}{name}": torch.from_numpy(np.array(array)) for name, array in arrays.items()}
        return {**facts, "moments": kept}, tensors

    def restore(self, facts: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        """Go on from what `state` returned."""
        arrays = {name: tensor.numpy() for name, tensor in under(MOMENTS, tensors).items()}
        self.moments = unpack(list[self.kind], facts["moments"], arrays)
        super().restore(facts, {n: t for n, t in tensors.items() if not n.startswith(MOMENTS)})


class RowImagination(Imagination[EnvironmentModel]):
    """The paper's: a row is a CAV with its leader and its follower."""

    def _new_model(self) -> EnvironmentModel:
        drawn = len(self._task.scenario.drawn_ranges)
        return EnvironmentModel(self.settings, drawn, self._seed(FIT), self.settings.device)

    def _fit(self, seed: Sequence[int]) -> Fit:
        actual = self.data.transitions(self.settings.holdout)
        return fit(self.model, actual, self.settings, self.scenario, self._task.reward, seed)

    def imagine(
        self, network: Network, iteration: int, part: int, parts: int, how: AsExperience
    ) -> Experience | None:
        """Return what the policy `network` does with rows; None where there are none."""
        rollouts = self.rollouts(network, iteration, part, parts)
        if rollouts is None:
            return None
        return rollout_experience(rollouts, how.seen_by_critic(rollouts.drawn.cpu().numpy()))

    def rollouts(self, network: Network, iteration: int, part: int = 0, parts: int = 1) -> Rollouts | None:
        """Return the virtual rollouts of rows; None where there are none."""
        driver = full_policy(self._task, self._policy, network)
        driven = self.k_star // driver.hold * driver.hold
        if driven == 0:
            return None
        seeds = [self._seed(iteration, purpose, part) for purpose in (STARTS, NOISE, EXPLORATION)]
        choices = self._starts(parts, seeds[0], driven)
        if len(choices) == 0:
            return None
        noise, exploration = (torch_generator(seed, self.settings.device) for seed in seeds[1:])
        world = VirtualDynamics(self.model, self.scenario, self._task.reward, noise, self.settings.noise)
        starts = begin(self.data, choices, self._task.expert, self.settings.device)
        rollouts = imagine(driver, world, starts, driven, exploration)
        self.steps += rollouts.decisions
        if part == 0:
            earned = rollouts.rewards.sum(1).double().cpu().numpy()
            self._compare(earned, rollouts.start, driven, float(rollouts.terminated.double().mean()))
            self.facts["bounded"] = rollouts.bounded
        return rollouts


def rollout_experience(rollouts: Rollouts, critic_inputs: NDArray[np.floating]) -> Experience:
    """Return virtual rollouts in the form in which learners take them; the cut at k* is no termination.

    `critic_inputs`, shape (n, m), is what the critic alone sees in each row.
    """
    made = rollouts.made.cpu().numpy()
    seen = rollouts.observations.cpu().numpy()
    extra = np.broadcast_to(critic_inputs[:, None], (*seen.shape[:2], critic_inputs.shape[1]))
    seen = np.concatenate([seen, extra], axis=2)
    counted = np.arange(seen.shape[1] - 1) < made[:, None]
    return Experience(
        observations=seen[:, :-1][counted].astype(np.float32),
        actions=rollouts.actions.cpu().numpy()[counted].astype(np.float32),
        rewards=rollouts.rewards.cpu().numpy()[counted].astype(np.float64),
        starts=np.concatenate([[0], made.cumsum()[:-1]]).astype(np.intp),
        last_observations=seen[np.arange(len(made)), made].astype(np.float32),
        terminated=rollouts.terminated.cpu().numpy(),
    )
