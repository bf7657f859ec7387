"""The controllable noisy TV as a Gymnasium environment and as a batched TorchRL environment."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_vjepa.noisy_tv.system import LinearGaussianSystem
from torchrl_vjepa.simulation import (
    BatchedSimulationEnv,
    Simulation,
    SimulationEnv,
    State,
    check_nonnegative,
    check_positive_int,
)

__all__ = ["BatchedNoisyTVEnv", "NoisyTVEnv"]


class _NoisyTV(Simulation):
    """The system and the cost."""

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
        super().__init__(
            system.observation_dim,
            system.control_dim,
            system.noise_dim,
            {"signal": system.signal_dim, "distractor": system.distractor_dim, "goal": system.signal_dim},
            action_bound=action_bound,
            episode_length=episode_length,
        )
        self.system = system
        self.noise_scale = check_nonnegative("noise_scale", noise_scale)
        self.action_cost = check_nonnegative("action_cost", action_cost)

    def start(self, noise: Tensor) -> State:
        return self._state(*self.system.start(noise, self.noise_scale))

    def step(self, state: State, action: Tensor, noise: Tensor) -> tuple[State, Tensor, Tensor]:
        after = self._state(
            *self.system.step(state["signal"], state["distractor"], action, noise, self.noise_scale)
        )
        # -(|s' - g|^2 + action_cost |u|^2)
        error = (after["signal"] - after["goal"]).square().sum(-1)
        reward = -(error + self.action_cost * action.square().sum(-1))
        return after, reward, torch.zeros_like(reward, dtype=torch.bool)

    def _state(self, signal: Tensor, distractor: Tensor, observation: Tensor) -> State:
        goal = self.system.goal.to(signal).expand_as(signal)
        return {"observation": observation, "signal": signal, "distractor": distractor, "goal": goal}


class NoisyTVEnv(SimulationEnv):
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
        task = _NoisyTV(noise_scale, system_seed, system, action_cost, action_bound, episode_length)
        super().__init__(task)
        self.system, self.noise_scale = task.system, task.noise_scale


class BatchedNoisyTVEnv(BatchedSimulationEnv):
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
        task = _NoisyTV(noise_scale, system_seed, system, action_cost, action_bound, episode_length)
        super().__init__(task, num_envs, seed=seed, device=device)
        self.system, self.noise_scale = task.system, task.noise_scale
