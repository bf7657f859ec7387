"""The fork as a Gymnasium environment and as a batched TorchRL environment."""

from __future__ import annotations

import torch

from torchrl_vjepa.fork.system import ForkSystem
from torchrl_vjepa.simulation import BatchedSimulationEnv, SimulationEnv

__all__ = ["BatchedForkEnv", "ForkEnv"]


class ForkEnv(SimulationEnv):
    r"""A vehicle that swerves round a wall, to the left or to the right, by chance.

    ## Description

    A vehicle drives along a road towards a wall. Just before it, a reflex that the agent does not
    command swerves to the left or to the right, by chance and by a fixed distance. The agent steers
    across the road. Two futures are possible, and an action is good only if *both* are: aiming at the
    middle of the wall is safe, since the vehicle passes on either side; aiming beside the wall is not,
    since one of the swerves ends in it. A model that predicts a single Gaussian puts its mean between
    the two futures, and whoever plans on that mean learns the opposite.

    With the default :class:`ForkSystem`, position *x = (along, across)*, left positive:

    - each step: *x' = x + (1.5, u) + sigma eps*, *eps ~ N(0, I)*, *sigma = 0.08*;
    - in the fork, *-2.75 <= along < -1.25*, also *+1.2 n(x)* (left) or *-1.2 n(x)* (right), with
      probability 1/2 each, and *n(x) = (across, -along) / |x|*, at a right angle to the line of sight
      to the wall's centre;
    - the wall is *|along| <= 1.25, |across| <= 0.7*.

    The exact predictive density is :meth:`ForkSystem.dist`; the exact probability to be in the wall
    after the next step is :meth:`ForkSystem.wall_mass`.

    ## Action Space

    The action is a `ndarray` with shape `(1,)` and dtype `float32`: the step `u` across the road.
    Actions out of bounds are clipped. An action of another shape, or NaN, or infinite, raises a
    `ValueError` and leaves the environment as it was.

    | Num | Action        | Min  | Max |
    |-----|---------------|------|-----|
    | 0   | Steering `u`  | -0.6 | 0.6 |

    ## Observation Space

    The observation is a `ndarray` with shape `(2,)` and dtype `float32`: the position, without noise.

    | Num | Observation          | Min  | Max |
    |-----|----------------------|------|-----|
    | 0   | Position along road  | -Inf | Inf |
    | 1   | Position across road | -Inf | Inf |

    `info` holds, for evaluation, `side` (1, `float32`): the swerve of the step before, 1 for left, -1
    for right, 0 for none.

    ## Rewards

    *r = -(across'<sup>2</sup> + 0.1 u<sup>2</sup> + 100 [x' in the wall])*

    with *x'* the position after the step and *u* the clipped action.

    ## Starting State

    *along = -5*, *across ~ N(0, 0.6<sup>2</sup>)*.

    ## Episode End

    The episode terminates when the vehicle is in the wall, and truncates after 6 steps, when it has
    passed. Only the position after a step counts, not the way to it. `step` after the end raises a
    `RuntimeError`.

    ## Randomness

    At each reset one integer drawn from `np_random` seeds the episode's own stream of normal numbers,
    three for the start and three for each step, so that neither the side nor the noise depends on the
    actions: agents compared on the same seed meet the same luck. :class:`BatchedForkEnv` makes the
    same numbers.

    ## Arguments

    - `system`: a :class:`ForkSystem` in place of the default one; its arguments are the probability of
      the left side, the sizes of swerve, wall and noise, and the costs.

    ## Examples

    ```python
    >>> import gymnasium as gym
    >>> import torchrl_vjepa
    >>> env = gym.make("torchrl_vjepa/Fork-v0", system=torchrl_vjepa.ForkSystem(left_probability=0.3))
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, sorted(info)
    ((2,), ['side'])
    >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

    ```

    ## Version History

    * v0: Initial version
    """

    def __init__(self, system: ForkSystem | None = None) -> None:
        self.system = ForkSystem() if system is None else system
        super().__init__(self.system)


class BatchedForkEnv(BatchedSimulationEnv):
    r"""Many :class:`ForkEnv` at once, in pure PyTorch: thousands of episodes in one rollout.

    Row ``i`` gives the episodes of ``ForkEnv`` seeded with ``seed + i``, number for number (to float32
    rounding): its k-th reset starts the k-th episode of that environment. Neither side nor noise
    depends on the actions. Rows reset one by one by the ``"_reset"`` mask; out-of-bounds actions are
    clipped.

    Entries, with ``N = num_envs``: ``observation (N, 2)``, ``side (N, 1)``, ``action (N, 1)`` in
    ``[-action_bound, action_bound]``, ``reward (N, 1)``, and ``done``, ``terminated`` (in the wall),
    ``truncated (N, 1)``. Floats are float32. ``side`` is there for evaluation.

    Rows end at different times: roll out with ``break_when_any_done=False``, to which
    ``break_when_all_done=True`` adds that rows wait instead of starting anew.

    Args:
        num_envs: ``N``, the number of episodes side by side.
        system: a system in place of the default one.
        seed: seed of row 0; row ``i`` has ``seed + i``. None takes entropy from the system.
        device: device of all tensors; the noise is drawn on the CPU.

    Raises:
        ValueError: for an argument out of range.

    Examples:
        >>> env = BatchedForkEnv(64, seed=0)
        >>> rollout = env.rollout(6, break_when_any_done=False, break_when_all_done=True)
        >>> rollout.batch_size, rollout["observation"].shape
        (torch.Size([64, 6]), torch.Size([64, 6, 2]))
    """

    def __init__(
        self,
        num_envs: int,
        system: ForkSystem | None = None,
        *,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        self.system = ForkSystem() if system is None else system
        super().__init__(self.system, num_envs, seed=seed, device=device)
