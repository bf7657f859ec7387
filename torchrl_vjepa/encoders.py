"""Encoders: TensorDictModules from ``observation`` to ``latent``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torchrl.modules import MLP, GRUModule

from torchrl_vjepa.stacking import is_plain_linear, linear
from torchrl_vjepa.whitening import Whitening, check_observation, check_size

__all__ = ["history_encoder", "linear_encoder", "mlp_encoder"]


class _ObservationNetwork(nn.Module):
    """Check the observation, whiten it, encode it: each row for itself."""

    row_wise = True

    def __init__(
        self,
        network: nn.Module,
        observation_dim: int,
        whitening: Whitening | None,
        key: NestedKey,
    ) -> None:
        super().__init__()
        _check_whitening(whitening, observation_dim)
        self.observation_dim = observation_dim
        self.key = key
        self.whitening = whitening
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        dtype = next(self.network.parameters()).dtype
        check_observation(observation, self.observation_dim, self.key, dtype)
        if self.stackable:
            return self._linear(observation)
        return self.network(observation if self.whitening is None else self.whitening(observation))

    @property
    def stackable(self) -> bool:
        """Whether weights of several models, stacked, can be used as they are: see ``linear``."""
        return is_plain_linear(self.network)

    def _linear(self, observation: Tensor) -> Tensor:
        weight: Any = self.network.weight
        bias: Any = self.network.bias
        if self.whitening is None:
            return linear(observation, weight, bias)
        # One product instead of two; for several models at once the larger one is not repeated.
        weight = weight @ self.whitening.transform.mT
        mean = self.whitening.mean.to(observation.dtype)
        return linear(observation - (mean if mean.ndim == 1 else mean.unsqueeze(-2)), weight, bias)


class _ResidualMLP(nn.Module):
    """A linear map and an MLP that bends it."""

    def __init__(self, linear: nn.Linear, mlp: MLP) -> None:
        super().__init__()
        self.linear = linear
        self.mlp = mlp

    def forward(self, observation: Tensor) -> Tensor:
        return self.linear(observation) + self.mlp(observation)


def linear_encoder(
    observation_dim: int,
    latent_dim: int,
    *,
    bias: bool = False,
    whitening: Whitening | None = None,
    in_key: NestedKey = "observation",
    out_key: NestedKey = "latent",
) -> TensorDictModule:
    r"""Linear encoder, :math:`Z_t = W x_t`: the encoder of the paper's noisy-TV experiment.

    Args:
        observation_dim: Features of the observation :math:`O`, at least 1.
        latent_dim: Size of the latent :math:`D`, at least 1.
        bias: Whether to add a bias. The paper's encoder is strictly linear.
        whitening: Applied to the observation first. Not trained; see :class:`Whitening`.
        in_key: Key of the observation, shape ``(*B, O)``.
        out_key: Key that the latent is written to, shape ``(*B, D)``.

    Returns:
        A TensorDictModule from ``in_key`` to ``out_key``. It raises ``ValueError`` for an
        observation of another size and ``TypeError`` for another dtype than its weights'.

    Raises:
        ValueError: If a size is below 1 or the whitening has another ``observation_dim``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> encoder = linear_encoder(20, 4)
        >>> data = TensorDict(observation=torch.zeros(8, 10, 20), batch_size=[8, 10])
        >>> encoder(data)["latent"].shape
        torch.Size([8, 10, 4])
    """
    check_size("observation_dim", observation_dim)
    check_size("latent_dim", latent_dim)
    network = nn.Linear(observation_dim, latent_dim, bias=bias)
    return TensorDictModule(
        _ObservationNetwork(network, observation_dim, whitening, in_key),
        in_keys=[in_key],
        out_keys=[out_key],
    )


def mlp_encoder(
    observation_dim: int,
    latent_dim: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.SiLU,
    residual: bool = False,
    whitening: Whitening | None = None,
    in_key: NestedKey = "observation",
    out_key: NestedKey = "latent",
) -> TensorDictModule:
    r"""Multi-layer perceptron encoder, :math:`Z_t = f_\theta(x_t)` (``eq:context_encoder``).

    With ``residual=True`` it is :math:`f_\theta(x) = W x + \mathrm{MLP}_\theta(x)`: the linear map finds
    directions, the MLP bends them. Its parts are ``encoder.module.network.linear`` and ``.mlp``, so that
    they can start and decay differently.

    Args:
        observation_dim: Features of the observation :math:`O`, at least 1.
        latent_dim: Size of the latent :math:`D`, at least 1.
        num_cells: Width of each hidden layer, each at least 1; empty for an affine map.
        activation_class: Activation after each hidden layer; the output has none.
        residual: Whether a linear map of the (whitened) observation, without bias, is added to the
            output.
        whitening: Applied to the observation first. Not trained; see :class:`Whitening`.
        in_key: Key of the observation, shape ``(*B, O)``.
        out_key: Key that the latent is written to, shape ``(*B, D)``.

    Returns:
        A TensorDictModule from ``in_key`` to ``out_key``. It raises ``ValueError`` for an
        observation of another size and ``TypeError`` for another dtype than its weights'.

    Raises:
        ValueError: If a size is below 1 or the whitening has another ``observation_dim``.

    Examples:
        >>> import torch
        >>> encoder = mlp_encoder(20, 4, num_cells=(32,), in_key="state", out_key=("a", "latent"))
        >>> encoder(state=torch.zeros(8, 20)).shape
        torch.Size([8, 4])
        >>> sorted(dict(mlp_encoder(20, 4, residual=True).module.network.named_children()))
        ['linear', 'mlp']
    """
    check_size("observation_dim", observation_dim)
    check_size("latent_dim", latent_dim)
    for width in num_cells:
        check_size("num_cells", width)
    network: nn.Module = MLP(
        in_features=observation_dim,
        out_features=latent_dim,
        num_cells=list(num_cells),
        activation_class=activation_class,
    )
    if residual:
        network = _ResidualMLP(nn.Linear(observation_dim, latent_dim, bias=False), network)
    return TensorDictModule(
        _ObservationNetwork(network, observation_dim, whitening, in_key),
        in_keys=[in_key],
        out_keys=[out_key],
    )


class _HistoryEncoder(GRUModule):
    """Whitening, GRU and linear readout in one module; :func:`history_encoder` describes it."""

    def __init__(
        self,
        observation_dim: int,
        latent_dim: int,
        hidden_dim: int,
        *,
        num_layers: int = 1,
        whitening: Whitening | None = None,
        in_key: NestedKey = "observation",
        out_key: NestedKey = "latent",
        state_key: NestedKey = "history",
        is_init_key: NestedKey = "is_init",
    ) -> None:
        for name, size in (
            ("observation_dim", observation_dim),
            ("latent_dim", latent_dim),
            ("hidden_dim", hidden_dim),
            ("num_layers", num_layers),
        ):
            check_size(name, size)
        _check_whitening(whitening, observation_dim)
        next_state_key = unravel_key(("next", state_key))
        super().__init__(
            input_size=observation_dim,
            hidden_size=hidden_dim,
            num_layers=num_layers,
            # torch.nn.GRU has no batching rule for vmap.
            python_based=True,
            in_keys=[in_key, state_key],
            out_keys=[out_key, next_state_key],
        )
        # GRUModule insists on the name "is_init" in its constructor only.
        self.in_keys = [unravel_key(key) for key in (in_key, state_key, is_init_key)]
        self.observation_dim = observation_dim
        self.whitening = whitening
        self.readout = nn.Linear(hidden_dim, latent_dim)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encode one step, or a window under ``set_recurrent_mode(True)``."""
        observation_key, state_key, is_init_key = self.in_keys
        observation = tensordict[observation_key]
        check_observation(observation, self.observation_dim, observation_key, self.readout.weight.dtype)
        batch = observation.shape[:-1]
        windows = self.recurrent_mode
        if windows and (not batch or batch[-1] == 0):
            raise ValueError(
                f"{observation_key!r} must have shape (*B, T, {self.observation_dim}) under "
                f"set_recurrent_mode(True), with at least one step, got "
                f"{tuple(observation.shape)}."
            )
        steps = batch[-1] if windows else 1
        rows = batch.numel() // steps
        is_init = self._episode_starts(tensordict, is_init_key, batch)
        state = tensordict.get(state_key, None)
        state_shape = (*batch, self.gru.num_layers, self.gru.hidden_size)
        if state is None:
            state = observation.new_zeros(state_shape)
        elif state.shape != state_shape:
            raise ValueError(
                f"{state_key!r} must have shape {state_shape} to fit {observation_key!r} of shape "
                f"{tuple(observation.shape)}, got {tuple(state.shape)}."
            )

        x = observation if self.whitening is None else self.whitening(observation)
        # (N, T, O), the state before the first step (L, N, H), resets (N, T, 1)
        x = x.reshape(rows, steps, self.observation_dim)
        h = state.reshape(rows, steps, *state_shape[-2:])[:, 0].transpose(0, 1).contiguous()
        start = None if is_init is None else is_init.reshape(rows, steps, 1)
        features, states = [], []
        for t in range(steps):
            if start is not None:
                h = torch.where(start[:, t], 0, h)
            feature, h = self.gru(x[:, t : t + 1], h)
            features.append(feature)
            states.append(h.transpose(0, 1))
        latent = self.readout(torch.cat(features, 1))
        tensordict.set(self.out_keys[0], latent.reshape(*batch, latent.shape[-1]))
        tensordict.set(self.out_keys[1], torch.stack(states, 1).reshape(state_shape))
        return tensordict

    def _episode_starts(
        self, tensordict: TensorDictBase, is_init_key: NestedKey, batch: torch.Size
    ) -> Tensor | None:
        """First steps of episodes, shape ``batch``; ``None`` if nothing says so."""
        is_init = tensordict.get(is_init_key, None)
        if is_init is not None:
            return _as_flag(is_init, is_init_key, batch)
        done = tensordict.get(("next", "done"), None) if self.recurrent_mode else None
        if done is None:
            return None
        done = _as_flag(done, ("next", "done"), batch)
        return torch.cat([torch.zeros_like(done[..., :1]), done[..., :-1]], -1)


def history_encoder(
    observation_dim: int,
    latent_dim: int,
    hidden_dim: int,
    *,
    num_layers: int = 1,
    whitening: Whitening | None = None,
    in_key: NestedKey = "observation",
    out_key: NestedKey = "latent",
    state_key: NestedKey = "history",
    is_init_key: NestedKey = "is_init",
) -> TensorDictModuleBase:
    r"""Recurrent encoder of everything seen so far, :math:`Z_t = f_\theta(x_{\le t})`.

    .. math::
        h_t = \operatorname{GRU}(x_t, h_{t-1}), \qquad Z_t = W h_t + b, \qquad
        h_{t-1} = 0 \text{ where } x_t \text{ starts an episode}

    A TorchRL :class:`~torchrl.modules.GRUModule`; its two modes are chosen by
    :class:`~torchrl.modules.set_recurrent_mode`:

    - *acting* (default): one step per call. The state is read from ``state_key`` (zero if
      missing) and written to ``("next", state_key)``. An environment carries it once it has the
      transforms of ``torchrl.modules.get_env_transforms_from_module(encoder)``; without them
      every step starts from zero.
    - *windows*, under ``set_recurrent_mode(True)``: the last batch dimension is time. The state
      of the first step is the one stored there (zero if missing: drop the key from the window to
      start afresh), later ones are computed. The result equals acting step by step.

    At ``is_init`` the state is reset, whatever is stored. Without that key, acting resets nothing
    (the environment's primer writes the zero state at each reset), and in a window an episode
    starts after each step whose ``("next", "done")`` is set; if that is missing too, the window
    is taken as part of one episode.

    Unlike ``GRUModule`` it resets without looking at values: it runs under ``torch.func.vmap``
    (over stacked parameters, over data with their own ``is_init``, or both) and ``torch.compile``
    in both modes. It also writes the state of every step of a window, not of the last one only.

    Args:
        observation_dim: Features of the observation :math:`O`, at least 1.
        latent_dim: Size of the latent :math:`D`, at least 1.
        hidden_dim: Size of the recurrent state of a layer, at least 1.
        num_layers: Number of GRU layers, at least 1.
        whitening: Applied to the observation first. Not trained; see :class:`Whitening`.
        in_key: Key of the observation, ``(*B, O)``, in windows ``(*B, T, O)``.
        out_key: Key that the latent is written to, ``(*B, D)``, in windows ``(*B, T, D)``.
        state_key: Key of the recurrent state, ``(*B, num_layers, hidden_dim)``; the new one is
            written to ``("next", state_key)``. Two history encoders need two names.
        is_init_key: Key of the flag of an episode's first step (TorchRL's ``InitTracker``),
            boolean, ``(*B, 1)`` or ``(*B)``.

    Returns:
        A TensorDictModule. It raises ``ValueError`` for shapes that do not fit (a window without
        a time dimension too) and ``TypeError`` for an observation of another dtype than its
        weights'.

    Raises:
        ValueError: If a size is below 1 or the whitening has another ``observation_dim``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import set_recurrent_mode
        >>> encoder = history_encoder(3, 2, hidden_dim=8)
        >>> step = TensorDict(observation=torch.zeros(5, 3), batch_size=[5])  # acting
        >>> encoder(step)["latent"].shape, step["next", "history"].shape
        (torch.Size([5, 2]), torch.Size([5, 1, 8]))
        >>> window = TensorDict(observation=torch.zeros(5, 7, 3), batch_size=[5, 7])
        >>> with set_recurrent_mode(True):
        ...     encoder(window)["latent"].shape
        torch.Size([5, 7, 2])
    """
    return _HistoryEncoder(
        observation_dim,
        latent_dim,
        hidden_dim,
        num_layers=num_layers,
        whitening=whitening,
        in_key=in_key,
        out_key=out_key,
        state_key=state_key,
        is_init_key=is_init_key,
    )


def _check_whitening(whitening: Whitening | None, observation_dim: int) -> None:
    if whitening is not None and whitening.observation_dim != observation_dim:
        raise ValueError(
            f"whitening must have observation_dim={observation_dim} like the encoder, got "
            f"{whitening.observation_dim}."
        )


def _as_flag(flag: Tensor, key: NestedKey, batch: torch.Size) -> Tensor:
    """Check a boolean of shape ``batch`` or ``(*batch, 1)`` and return it with shape ``batch``."""
    if flag.shape not in (batch, (*batch, 1)):
        raise ValueError(f"{key!r} must have shape {tuple(batch)} or {(*batch, 1)}, got {tuple(flag.shape)}.")
    return flag.reshape(batch).bool()
