"""Simulated systems as environments: one set of equations, for Gymnasium and batched for TorchRL."""

from __future__ import annotations

import abc
import math
import operator
from collections.abc import Mapping
from typing import Any, TypeVar

import gymnasium
import numpy as np
import torch
from gymnasium.utils import seeding
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_vjepa.signatures import InitSignature

__all__ = [
    "BatchedSimulationEnv",
    "Simulation",
    "SimulationEnv",
    "State",
    "check_nonnegative",
    "check_positive_int",
]

State = dict[str, Tensor]
_BatchedEnv = TypeVar("_BatchedEnv", bound="BatchedSimulationEnv")


def check_nonnegative(name: str, value: float) -> float:
    """Returns ``value`` as a float, or refuses it.

    Args:
        name: the argument's name, for the error message.
        value: the number to check: finite and at least 0.

    Returns:
        The same number as a ``float``.

    Raises:
        ValueError: if it is negative, infinite or NaN.

    Examples:
        >>> check_nonnegative("noise_scale", 8)
        8.0
    """
    number = float(value)
    if not 0.0 <= number < math.inf:
        raise ValueError(f"{name} must be a finite number of at least 0, got {value}.")
    return number


def check_positive_int(name: str, value: int, minimum: int = 1) -> int:
    """Returns ``value`` as an int of at least ``minimum``, or refuses it.

    Args:
        name: the argument's name, for the error message.
        value: the number to check.
        minimum: the smallest number allowed.

    Returns:
        The same number as an ``int``.

    Raises:
        TypeError: if it is not an integer.
        ValueError: if it is too small.

    Examples:
        >>> check_positive_int("num_steps", 3)
        3
    """
    try:
        value = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be an integer, got {value!r}.") from None
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {value}.")
    return value


class Simulation(abc.ABC):
    """The equations of an environment: pure functions of state, action and standard normal noise.

    A state is a dictionary with ``observation`` and the entries that ``info_dims`` names, each of shape
    ``(*B, size)``: what the agent must not see, for evaluation. Both environments,
    :class:`SimulationEnv` and :class:`BatchedSimulationEnv`, run on it and give the same numbers.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        noise_dim: standard normal numbers that a start or a step uses.
        info_dims: the other entries of a state and their sizes.
        action_bound: largest action in each coordinate, positive.
        episode_length: steps until truncation.

    Raises:
        ValueError: for an argument out of range.
        TypeError: for a size that is not an integer.

    Examples:
        >>> class RandomWalk(Simulation):
        ...     def start(self, noise):
        ...         return {"observation": noise}
        ...
        ...     def step(self, state, action, noise):
        ...         position = state["observation"] + action + noise
        ...         return {"observation": position}, -position.abs().sum(-1), position[..., 0] > 9
        >>> walk = RandomWalk(1, 1, 1, {}, action_bound=1.0, episode_length=5)
        >>> BatchedSimulationEnv(walk, 3, seed=0).rollout(5).batch_size
        torch.Size([3, 5])
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        noise_dim: int,
        info_dims: Mapping[str, int],
        *,
        action_bound: float,
        episode_length: int,
    ) -> None:
        self.observation_dim = observation_dim
        self.action_dim = action_dim
        self.noise_dim = noise_dim
        self.info_dims = dict(info_dims)
        self.action_bound = check_nonnegative("action_bound", action_bound)
        if self.action_bound == 0:
            raise ValueError("action_bound must be positive, got 0.")
        self.episode_length = check_positive_int("episode_length", episode_length)

    @abc.abstractmethod
    def start(self, noise: Tensor) -> State:
        """The first state of an episode.

        Args:
            noise: standard normal numbers, shape ``(*B, noise_dim)``.

        Returns:
            The state.
        """

    @abc.abstractmethod
    def step(self, state: State, action: Tensor, noise: Tensor) -> tuple[State, Tensor, Tensor]:
        """One step.

        Args:
            state: the state before; it is not changed.
            action: inside the bounds, shape ``(*B, action_dim)``.
            noise: standard normal numbers, shape ``(*B, noise_dim)``.

        Returns:
            The next state; the reward, shape ``(*B)``; whether it ends the episode, boolean of shape
            ``(*B)``.
        """


def _episode_generator(seeder: np.random.Generator) -> np.random.Generator:
    """The stream of standard normal numbers of one episode: one integer off ``seeder``.

    Because it is the episode's own, its numbers do not depend on the actions, nor on how much of the
    episodes before was played.
    """
    return np.random.default_rng(int(seeder.integers(2**63 - 1)))


class SimulationEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A :class:`Simulation` as a Gymnasium environment, computed in float64.

    At each reset one integer drawn from ``np_random`` seeds the episode's own stream of normal numbers.
    Actions out of bounds are clipped. The environment counts its steps itself.

    Args:
        simulation: the equations.

    Examples:
        >>> from torchrl_vjepa import ForkEnv
        >>> issubclass(ForkEnv, SimulationEnv)
        True
    """

    metadata = {"render_modes": []}

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        bound = simulation.action_bound
        self.action_space = gymnasium.spaces.Box(-bound, bound, (simulation.action_dim,), dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (simulation.observation_dim,), dtype=np.float32
        )
        self._episode_rng: np.random.Generator | None = None
        self._state: State = {}
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
        self._episode_rng = _episode_generator(self.np_random)
        self._num_steps = 0
        self._state = self.simulation.start(self._draw(self._episode_rng))
        return self._numpy("observation"), self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Applies ``action`` for one step.

        Args:
            action: shape ``(action_dim,)``; clipped to the action space.

        Returns:
            Observation, reward, ``terminated``, ``truncated`` and ``info``.

        Raises:
            ValueError: if the action has a wrong shape, or is NaN or infinite.
            RuntimeError: before the first reset, or after the episode's end.
        """
        if self._episode_rng is None:
            raise RuntimeError("step needs a running episode: call reset first.")
        u = np.asarray(action, dtype=np.float64)
        if u.shape != self.action_space.shape or not np.isfinite(u).all():
            raise ValueError(f"action must be finite with shape {self.action_space.shape}, got {action!r}.")
        bound = self.simulation.action_bound
        control = torch.from_numpy(u).clamp(-bound, bound)
        self._state, reward, over = self.simulation.step(self._state, control, self._draw(self._episode_rng))
        self._num_steps += 1
        terminated, truncated = bool(over), self._num_steps >= self.simulation.episode_length
        if terminated or truncated:
            self._episode_rng = None
        return self._numpy("observation"), reward.item(), terminated, truncated, self._info()

    def _draw(self, rng: np.random.Generator) -> Tensor:
        return torch.from_numpy(rng.standard_normal(self.simulation.noise_dim))

    def _numpy(self, key: str) -> NDArray[np.float32]:
        return self._state[key].numpy().astype(np.float32)

    def _info(self) -> dict[str, Any]:
        return {key: self._numpy(key) for key in self.simulation.info_dims}


class BatchedSimulationEnv(EnvBase):
    """Many :class:`SimulationEnv` at once, in pure PyTorch: thousands of episodes in one rollout.

    Row ``i`` gives the episodes of the Gymnasium environment seeded with ``seed + i``, number for number
    (to float32 rounding): its k-th reset starts the k-th episode of that environment. The noise of an
    episode is drawn in one block at its reset, and does not depend on the actions. Rows reset one by one
    by the ``"_reset"`` mask; out-of-bounds actions are clipped. The environment keeps its own state and
    does not read the entries of its input, the action aside.

    Args:
        simulation: the equations.
        num_envs: ``N``, the number of episodes side by side.
        seed: seed of row 0; row ``i`` has ``seed + i``. None takes entropy from the system.
        device: device of all tensors; the noise is drawn on the CPU.

    Raises:
        ValueError: for an argument out of range.

    Examples:
        >>> from torchrl_vjepa import BatchedForkEnv
        >>> issubclass(BatchedForkEnv, BatchedSimulationEnv)
        True
    """

    __signature__ = InitSignature()

    def __init__(
        self,
        simulation: Simulation,
        num_envs: int,
        *,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        num_envs = check_positive_int("num_envs", num_envs)
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.simulation = simulation

        def unbounded(size: int) -> Unbounded:
            return Unbounded((num_envs, size), device=self.device, dtype=torch.float32)

        self.observation_spec = Composite(
            {
                "observation": unbounded(simulation.observation_dim),
                **{key: unbounded(size) for key, size in simulation.info_dims.items()},
            },
            shape=self.batch_size,
            device=self.device,
        )
        bound = simulation.action_bound
        self.action_spec = Bounded(
            -bound, bound, (num_envs, simulation.action_dim), device=self.device, dtype=torch.float32
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
        noise_shape = (num_envs, simulation.episode_length + 1, simulation.noise_dim)
        self._noise = torch.zeros(noise_shape, dtype=torch.float32, device=self.device)
        self._rows = torch.arange(num_envs, device=self.device)
        # A row that was never reset counts as over.
        self._time = torch.full((num_envs,), simulation.episode_length, device=self.device)
        self._terminated = torch.zeros((num_envs,), dtype=torch.bool, device=self.device)
        self._state = self.observation_spec.zero()
        self._set_seed(seed)

    def to(self: _BatchedEnv, device: torch.device | str) -> _BatchedEnv:
        """Moves the environment, running episodes included.

        Args:
            device: where to.

        Returns:
            The environment itself.
        """
        super().to(device)
        for name in ("_noise", "_rows", "_time", "_terminated", "_state"):
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
        shape = self._noise.shape[1:]
        # Cast row by row: the float64 stream of thousands of episodes need not stay in memory.
        noise = np.empty((len(rows), *shape), dtype=np.float32)
        for index, row in enumerate(rows.tolist()):
            noise[index] = _episode_generator(self._seeders[row]).standard_normal(shape)
        self._noise[rows] = torch.from_numpy(noise).to(self._noise.device)
        self._time[rows] = 0
        # New tensors: the previous state may be in a caller's hands.
        self._terminated = self._terminated.clone()
        self._terminated[rows] = False
        self._state = self._state.clone()
        for key, value in self.simulation.start(self._noise[rows, 0]).items():
            self._state[key][rows] = value
        return self._state.clone().update(self._flags())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key)
        # Rollouts that outlast some rows mask those out with "_step".
        mask = tensordict.get("_step", None)
        active = torch.ones_like(self._rows, dtype=torch.bool) if mask is None else mask.view(-1)
        shape = (*self.batch_size, self.simulation.action_dim)
        if action.shape != shape:
            raise ValueError(f"action must have shape {shape}, got {tuple(action.shape)}.")
        if not action[active].isfinite().all():
            raise ValueError("action must be finite, got NaN or infinite entries.")
        length = self.simulation.episode_length
        if ((self._time >= length) | self._terminated)[active].any():
            raise RuntimeError("step needs running episodes: reset the rows that are done first.")
        bound = self.simulation.action_bound
        action = action.to(self._noise.dtype).clamp(-bound, bound)
        time = (self._time + 1).clamp_max(length)
        state, reward, terminated = self.simulation.step(
            dict(self._state.items()), action, self._noise[self._rows, time]
        )
        new = TensorDict(state, batch_size=self.batch_size, device=self.device)
        if mask is None:
            self._state, self._time, self._terminated = new, time, terminated
        else:
            self._state = torch.where(active, new, self._state)
            self._time = torch.where(active, time, self._time)
            self._terminated = torch.where(active, terminated, self._terminated)
        return self._state.clone().update(self._flags()).set("reward", reward.unsqueeze(-1))

    def _flags(self) -> dict[str, Tensor]:
        truncated = (self._time >= self.simulation.episode_length).unsqueeze(-1)
        terminated = self._terminated.unsqueeze(-1)
        return {"done": truncated | terminated, "terminated": terminated.clone(), "truncated": truncated}
