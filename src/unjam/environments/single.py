"""A road with one CAV as a Gymnasium environment."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from unjam.drivers.observation import FeatureName
from unjam.environments.road import SteppedRoad
from unjam.errors import InputError
from unjam.reports.film import draw_road

Observation = NDArray[Any]


class RoadEnv(gymnasium.Env[Observation, Observation]):
    """One CAV among people, on the actual simulator.

    ``gymnasium.make("unjam/Ring-v0")``, ``"unjam/FigureEight-v0"``, ``"unjam/Merge-v0"``; every parameter of
    the scenario can be given: ``gymnasium.make("unjam/Ring-v0", scenario="ring-jammed", length=(230, 230))``.

    ===========  ===================================================================================
    Action       ``Box(-limit, limit, (1,), float32)``: acceleration [m/s2], limit 1 by default; with
                 ``expert``, what is added to the expert's
    Observation  ``Box(-50, 50, (5,), float32)``: own speed / 10 m/s; leader's speed - own / 5 m/s; gap
                 to the leader / 20 m; follower's speed - own / 5 m/s; gap to the follower / 20 m; more
                 with ``observe``
    Reward       the scenario's, or ``reward``; its terms are in ``info["terms"]``
    Start        ``reset(seed=s)`` starts the very episode that ``unjam drive --seed s`` runs, warm-up
                 included
    Terminated   at a collision
    Truncated    at the horizon; on the merge also when the CAV leaves the road
    Time step    one decision: 0.1 s, on the merge 1 s
    ===========  ===================================================================================

    libsumo runs one simulation in a process: a second environment there runs over TraCI, twenty times slower.
    For several at once use ``gymnasium.make_vec("unjam/Ring-v0", num_envs=4, vectorization_mode="async")``.
    """

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        scenario: str = "ring",
        reward: str = "",
        expert: str = "",
        observe: Sequence[FeatureName] = ("local",),
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        """Prepare the environment; SUMO is opened by the first `reset`.

        Args:
            scenario: its name.
            reward: a name or `path.py:name`; empty: the scenario's own.
            expert: a driver to whose acceleration actions are added, named as in `unjam drive --driver`.
            observe: parts of the observation: `local`, `expert_acceleration`, `expert_memory`, `loop_length`,
                `place`.
            render_mode: `rgb_array`, or `human` for SUMO's own window.
            changes: to the scenario's parameters.

        Raises:
            InputError: something of it is wrong, or the road has several CAVs.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode: {render_mode!r} is not allowed; allowed: human, rgb_array")
        self.render_mode = render_mode
        backend = "gui" if render_mode == "human" else "libsumo"
        self._road = SteppedRoad(scenario, changes, reward, expert, observe, backend)
        if getattr(self._road.scenario, "cavs", None) != 1:
            raise InputError("cavs: several are not allowed here; allowed: 1; use unjam.parallel_env")
        self.observation_space = self._road.observation_space
        self.action_space = self._road.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode: that of `seed`; without one, the next after the last seed's."""
        super().reset(seed=seed)
        observations = self._road.reset(seed, self.np_random)
        return observations[0], {"drawn": dict(self._road.traffic.road.drawn)}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make one decision."""
        done = self._road.step(np.asarray(action, np.float64).reshape(1))
        observation = next(iter(done.left.values())) if done.left else done.observations[0]
        truncated = done.truncated or (bool(done.left) and not done.terminated)
        return observation, done.reward, done.terminated, truncated, {"terms": done.terms}

    def render(self) -> Any:
        """Return the picture of this moment, shape (640, 640, 3); SUMO's window draws itself."""
        if self.render_mode != "rgb_array":
            return None
        traffic = self._road.traffic
        fastest = 2.0 * traffic.road.limit_speed
        return np.asarray(draw_road(traffic.scene(), fastest, f"mean {np.mean(traffic.speeds):.1f} m/s"))

    def close(self) -> None:
        """End SUMO; may be called twice."""
        self._road.close()
