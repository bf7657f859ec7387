"""The controllable noisy TV as a Gymnasium environment and as a batched TorchRL environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.utils import seeding
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_vjepa.noisy_tv.system import (
    LinearGaussianSystem,
    check_nonnegative,
    check_positive_int,
)

__all__ = ["BatchedNoisyTVEnv", "NoisyTVEnv"]


class _Task:
    """What both environments share: the system, the cost, and the random stream of an episode."""

    def __init__(
        self,
        noise_scale: float,
        system_seed: int | None,
        system: LinearGaussianSystem | None,
        action_cost: float,
        action_bound: float,
        episode_length: int,
    ) -> None:
        if system is None:
            system = LinearGaussianSystem(control_dim=2, seed=0 if system_seed is None else system_seed)
        elif system_seed is not None:
            raise ValueError(
                f"system_seed must be None when a system is given, got {system_seed}: "
                "the system has its own seed."
            )
        check_positive_int("system.control_dim", system.control_dim)
        self.system = system
        self.noise_scale = check_nonnegative("noise_scale", noise_scale)
        self.action_cost = check_nonnegative("action_cost", action_cost)
        self.action_bound = check_nonnegative("action_bound", action_bound)
        if self.action_bound == 0:
            raise ValueError("action_bound must be positive, got 0.")
        self.episode_length = check_positive_int("episode_length", episode_length)

    def reward(self, next_signal: Tensor, action: Tensor) -> Tensor:
        """``-(|s' - g|^2 + action_cost |u|^2)``, shape ``(*B)``."""
        error = next_signal - self.system.goal.to(next_signal)
        return -(error.square().sum(-1) + self.action_cost * action.square().sum(-1))

    @staticmethod
    def episode_generator(seeder: np.random.Generator) -> np.random.Generator:
        """The stream of standard normal numbers of one episode: one integer off ``seeder``.

        Because it is the episode's own, its numbers do not depend on the actions, nor on how much
        of the episodes before was played.
        """
        return np.random.default_rng(int(seeder.integers(2**63 - 1)))


class NoisyTVEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    r"""A small signal to steer, under a distractor that dominates the observation.

    ## Description

    A small signal has to be steered to a goal while it is watched through a sensor that a large,
    slow distractor dominates: the paper's noisy TV (section "Toy Experiment") with a control
    input. The distractor is predictable and harmless; a world model that spends its capacity on
    it loses the signal. With the default :class:`LinearGaussianSystem`,

    - signal: *s' = A s + B u + w*, `A` orthogonal, *w ~ N(0, 0.1<sup>2</sup> I)*;
    - distractor: *d' = 0.9 d + v*, *v ~ N(0, 0.3<sup>2</sup> I)*;
    - observation: *x = C s + D (noise_scale d) + eps*, *eps ~ N(0, 0.01<sup>2</sup> I)*.

    ## Action Space

    The action is a `ndarray` with shape `(2,)` and dtype `float32`: the control `u`. Actions out
    of bounds are clipped. An action of another shape, or NaN, or infinite, raises a `ValueError`
    and leaves the environment as it was.

    | Num | Action  | Min  | Max |
    |-----|---------|------|-----|
    | 0-1 | Control | -2.0 | 2.0 |

    ## Observation Space

    The observation is a `ndarray` with shape `(20,)` and dtype `float32`.

    | Num  | Observation         | Min  | Max |
    |------|---------------------|------|-----|
    | 0-19 | Sensor reading `x`  | -Inf | Inf |

    `info` carries what the agent must not see, for evaluation: `signal` (4), `distractor` (4) and
    `goal` (4), all `float32`.

    ## Rewards

    *r = -(|s' - g|<sup>2</sup> + 0.1 |u|<sup>2</sup>)*

    with *s'* the signal after the step, *u* the clipped action, and *g* the system's goal of norm
    1. The maximum is zero.

    ## Starting State

    `s` and `d` are standard normal.

    ## Episode Truncation

    The episode truncates at 200 time steps; it never terminates. The environment counts the steps
    itself, so this holds without `gymnasium.make` too. `step` after that raises a `RuntimeError`.

    ## Randomness

    At each reset one integer drawn from `np_random` seeds the episode's own stream of normal
    numbers, so that the noise of an episode does not depend on the actions: controllers compared
    on the same seed meet the same noise. :class:`BatchedNoisyTVEnv` makes the same numbers.

    ## Arguments

    - `noise_scale`: scale of the distractor in the observation, at least 0. Default 8.
    - `system_seed`: draws the matrices and the goal. Default 0.
    - `system`: a :class:`LinearGaussianSystem` with control, in place of the one that
      `system_seed` draws.
    - `action_cost`: weight of |u|<sup>2</sup>, at least 0. Default 0.1.
    - `action_bound`: largest control in each coordinate, positive. Default 2.
    - `episode_length`: steps until truncation. Default 200.

    ## Examples

    ```python
    >>> import gymnasium as gym
    >>> import torchrl_vjepa.noisy_tv
    >>> env = gym.make("torchrl_vjepa/NoisyTV-v0", noise_scale=4.0, system_seed=1)
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, sorted(info)
    ((20,), ['distractor', 'goal', 'signal'])
    >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

    ```

    ## Version History

    * v0: Initial version
    """

    metadata = {"render_modes": []}

    def __init__(
        self,
        noise_scale: float = 8.0,
        *,
        system_seed: int | None = None,
        system: LinearGaussianSystem | None = None,
        action_cost: float = 0.1,
        action_bound: float = 2.0,
        episode_length: int = 200,
    ) -> None:
        self._task = _Task(noise_scale, system_seed, system, action_cost, action_bound, episode_length)
        self.system = self._task.system
        self.noise_scale = self._task.noise_scale
        self.action_space = gymnasium.spaces.Box(
            -self._task.action_bound,
            self._task.action_bound,
            (self.system.control_dim,),
            dtype=np.float32,
        )
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (self.system.observation_dim,), dtype=np.float32
        )
        self._episode_rng: np.random.Generator | None = None
        self._num_steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: restarts the sequence of episodes.
            options: not used.

        Returns:
            The first observation and ``info``.
        """
        super().reset(seed=seed)
        self._episode_rng = self._task.episode_generator(self.np_random)
        self._num_steps = 0
        self._signal, self._distractor, observation = self.system.start(
            self._draw(self._episode_rng), self.noise_scale
        )
        return self._numpy(observation), self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Applies the control ``action`` for one step.

        Args:
            action: ``u``, shape ``(control_dim,)``; clipped to the action space.

        Returns:
            Observation, reward, ``terminated`` (always False), ``truncated`` and ``info``.

        Raises:
            ValueError: if the action has a wrong shape, or is NaN or infinite.
            RuntimeError: before the first reset, or after the episode's end.
        """
        if self._episode_rng is None or self._num_steps >= self._task.episode_length:
            raise RuntimeError("step needs a running episode: call reset first.")
        u = np.asarray(action, dtype=np.float64)
        if u.shape != self.action_space.shape or not np.isfinite(u).all():
            raise ValueError(f"action must be finite with shape {self.action_space.shape}, got {action!r}.")
        control = torch.from_numpy(u).clamp(-self._task.action_bound, self._task.action_bound)
        self._signal, self._distractor, observation = self.system.step(
            self._signal,
            self._distractor,
            control,
            self._draw(self._episode_rng),
            self.noise_scale,
        )
        self._num_steps += 1
        reward = self._task.reward(self._signal, control).item()
        truncated = self._num_steps >= self._task.episode_length
        return self._numpy(observation), reward, False, truncated, self._info()

    def _draw(self, rng: np.random.Generator) -> Tensor:
        return torch.from_numpy(rng.standard_normal(self.system.noise_dim))

    def _numpy(self, value: Tensor) -> NDArray[np.float32]:
        return value.numpy().astype(np.float32)

    def _info(self) -> dict[str, Any]:
        return {
            "signal": self._numpy(self._signal),
            "distractor": self._numpy(self._distractor),
            "goal": self._numpy(self.system.goal),
        }


class BatchedNoisyTVEnv(EnvBase):
    r"""Many :class:`NoisyTVEnv` at once, in pure PyTorch: thousands of episodes in one rollout.

    Row ``i`` gives the episodes of ``NoisyTVEnv`` seeded with ``seed + i``, number for number (to
    float32 rounding): its k-th reset starts the k-th episode of that environment. The noise of an
    episode is drawn in one block at its reset, and does not depend on the actions. Rows reset one
    by one by the ``"_reset"`` mask; out-of-bounds actions are clipped.

    Entries, with ``N = num_envs``: ``observation (N, observation_dim)``, ``signal (N,
    signal_dim)``, ``distractor (N, distractor_dim)``, ``goal (N, signal_dim)``, ``action (N,
    control_dim)`` in ``[-action_bound, action_bound]``, ``reward (N, 1)``, and ``done``,
    ``terminated`` (always False), ``truncated (N, 1)``. Floats are float32. ``signal``,
    ``distractor`` and ``goal`` are there for evaluation; the environment keeps its own state and
    does not read them.

    Args:
        num_envs: ``N``, the number of episodes side by side.
        noise_scale: scale of the distractor in the observation, at least 0.
        system_seed: draws the matrices and the goal; 0 by default.
        system: a system with control, in place of the one that ``system_seed`` draws.
        action_cost: weight of ``|u|^2`` in the cost, at least 0.
        action_bound: largest control in each coordinate, positive.
        episode_length: steps until truncation.
        seed: seed of row 0; row ``i`` has ``seed + i``. None takes entropy from the system.
        device: device of all tensors; the noise is drawn on the CPU.

    Raises:
        ValueError: for an argument out of range, or both ``system`` and ``system_seed``.

    Examples:
        >>> env = BatchedNoisyTVEnv(64, noise_scale=8.0, seed=0)
        >>> rollout = env.rollout(200)
        >>> rollout.batch_size, rollout["observation"].shape
        (torch.Size([64, 200]), torch.Size([64, 200, 20]))
    """

    def __init__(
        self,
        num_envs: int,
        noise_scale: float = 8.0,
        *,
        system_seed: int | None = None,
        system: LinearGaussianSystem | None = None,
        action_cost: float = 0.1,
        action_bound: float = 2.0,
        episode_length: int = 200,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        num_envs = check_positive_int("num_envs", num_envs)
        self._task = _Task(noise_scale, system_seed, system, action_cost, action_bound, episode_length)
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.system = self._task.system
        self.noise_scale = self._task.noise_scale

        def unbounded(size: int) -> Unbounded:
            return Unbounded((num_envs, size), device=self.device, dtype=torch.float32)

        self.observation_spec = Composite(
            observation=unbounded(self.system.observation_dim),
            signal=unbounded(self.system.signal_dim),
            distractor=unbounded(self.system.distractor_dim),
            goal=unbounded(self.system.signal_dim),
            shape=self.batch_size,
            device=self.device,
        )
        bound = self._task.action_bound
        self.action_spec = Bounded(
            -bound,
            bound,
            (num_envs, self.system.control_dim),
            device=self.device,
            dtype=torch.float32,
        )
        self.reward_spec = unbounded(1)
        flag = Binary(shape=(num_envs, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(
            done=flag,
            terminated=flag.clone(),
            truncated=flag.clone(),
            shape=self.batch_size,
            device=self.device,
        )
        noise_shape = (num_envs, self._task.episode_length + 1, self.system.noise_dim)
        self._noise = torch.zeros(noise_shape, dtype=torch.float32, device=self.device)
        self._rows = torch.arange(num_envs, device=self.device)
        # A row that was never reset counts as over.
        self._time = torch.full((num_envs,), self._task.episode_length, device=self.device)
        self._state = self.observation_spec.zero()
        self._state["goal"] = self.system.goal.to(self._state["goal"]).expand_as(self._state["goal"])
        self._set_seed(seed)

    def to(self, device: torch.device | str) -> BatchedNoisyTVEnv:
        """Moves the environment, running episodes included.

        Args:
            device: where to.

        Returns:
            The environment itself.
        """
        super().to(device)
        for name in ("_noise", "_rows", "_time", "_state"):
            setattr(self, name, getattr(self, name).to(self.device))
        return self

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            check_positive_int("seed", seed, minimum=0)
        self._seeders = [
            seeding.np_random(None if seed is None else seed + row)[0] for row in range(self.batch_size[0])
        ]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = self._rows if mask is None else self._rows[mask.reshape(self.batch_size)]
        shape = (self._task.episode_length + 1, self.system.noise_dim)
        # Cast row by row: the float64 stream of thousands of episodes need not stay in memory.
        noise = np.empty((len(rows), *shape), dtype=np.float32)
        for index, row in enumerate(rows.tolist()):
            noise[index] = self._task.episode_generator(self._seeders[row]).standard_normal(shape)
        self._noise[rows] = torch.from_numpy(noise).to(self._noise.device)
        self._time[rows] = 0
        signal, distractor, observation = self.system.start(self._noise[rows, 0], self.noise_scale)
        # New tensors: the previous state may be in a caller's hands.
        self._state = self._state.clone()
        for key, value in (
            ("signal", signal),
            ("distractor", distractor),
            ("observation", observation),
        ):
            self._state[key][rows] = value
        return self._state.clone().update(self._flags())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key)
        # Rollouts that outlast some rows mask those out with "_step".
        mask = tensordict.get("_step", None)
        active = torch.ones_like(self._rows, dtype=torch.bool) if mask is None else mask.view(-1)
        shape = (*self.batch_size, self.system.control_dim)
        if action.shape != shape:
            raise ValueError(f"action must have shape {shape}, got {tuple(action.shape)}.")
        if not action[active].isfinite().all():
            raise ValueError("action must be finite, got NaN or infinite entries.")
        if (self._time[active] >= self._task.episode_length).any():
            raise RuntimeError("step needs running episodes: reset the rows that are done first.")
        bound = self._task.action_bound
        action = action.to(self._noise.dtype).clamp(-bound, bound)
        time = (self._time + 1).clamp_max(self._task.episode_length)
        signal, distractor, observation = self.system.step(
            self._state["signal"],
            self._state["distractor"],
            action,
            self._noise[self._rows, time],
            self.noise_scale,
        )
        reward = self._task.reward(signal, action).unsqueeze(-1)
        new = TensorDict(
            {
                "signal": signal,
                "distractor": distractor,
                "observation": observation,
                "goal": self._state["goal"],
            },
            batch_size=self.batch_size,
            device=self.device,
        )
        if mask is None:
            self._state, self._time = new, time
        else:
            self._state = torch.where(active, new, self._state)
            self._time = torch.where(active, time, self._time)
        return self._state.clone().update(self._flags()).set("reward", reward)

    def _flags(self) -> dict[str, Tensor]:
        truncated = (self._time >= self._task.episode_length).unsqueeze(-1)
        return {
            "done": truncated,
            "terminated": torch.zeros_like(truncated),
            "truncated": truncated.clone(),
        }
