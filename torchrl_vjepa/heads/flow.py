"""Futures of any shape: a conditional normalising flow."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_vjepa.distributions import Coupling, CouplingFlow
from torchrl_vjepa.distributions.splines import spline_size
from torchrl_vjepa.heads.base import Head, checked_range, checked_size, soft_clamp

__all__ = ["FlowHead"]


class FlowHead(Head):
    r"""Conditional normalising flow: an exact density of any shape (:class:`CouplingFlow`).

    Features are the location, and for each dimension the log-variance and the parameters of its spline,
    and what the state contributes to the hidden layer of every coupling. The constants hold the weights
    of the couplings (one hidden layer of ``num_cells``), so every skip has its own flow.

    It starts as a Gaussian whose couplings are nearly the identity. Density and draws are exact. The mean
    is an average over ``num_points`` fixed points and costs as many draws; the mode is searched for.

    Args:
        num_layers: coupling layers (none are needed for ``D = 1``).
        num_cells: width of their hidden layers.
        num_bins: bins of the splines.
        num_points: points that mean and variance average over.
        log_var_range: ``(low, high)`` of the logarithm of the squared scale, in nats.

    Raises:
        ValueError: if a size is not positive, ``num_layers`` is negative, there are fewer than 2 bins, or
            the range is empty or infinite.

    Examples:
        >>> import torch
        >>> head = FlowHead(num_layers=2)
        >>> p = head(torch.zeros(5, head.num_features(3)), head.init_constants(3))
        >>> p.batch_shape, p.log_prob(torch.zeros(5, 3)).shape
        (torch.Size([5]), torch.Size([5]))
    """

    def __init__(
        self,
        num_layers: int = 4,
        num_cells: int = 32,
        num_bins: int = 8,
        *,
        num_points: int = 64,
        log_var_range: tuple[float, float] = (-16.0, 16.0),
    ) -> None:
        super().__init__()
        if num_layers < 0:
            raise ValueError(f"num_layers must be at least 0, got {num_layers}")
        if not 2 <= num_bins <= 50:
            raise ValueError(f"num_bins must be in [2, 50], got {num_bins}")
        self.num_layers = int(num_layers)
        self.num_cells = checked_size("num_cells", num_cells)
        self.num_bins = int(num_bins)
        self.num_points = checked_size("num_points", num_points)
        self.log_var_range = checked_range(log_var_range)

    def num_features(self, latent_dim: int) -> int:
        """Location, log-variances, splines, and a hidden layer per coupling.

        Args:
            latent_dim: size of the latent.

        Returns:
            The size that the predictor's trunk must have.
        """
        num_couplings = len(self._shapes(latent_dim))
        return latent_dim * (2 + spline_size(self.num_bins)) + num_couplings * self.num_cells

    def num_constants(self, latent_dim: int) -> int:
        """Log-variances, splines, and the weights of the couplings.

        Args:
            latent_dim: size of the latent.

        Returns:
            The size of each skip's row of constants.
        """
        return latent_dim * (1 + spline_size(self.num_bins)) + sum(
            sum(self._sizes(*shape)) for shape in self._shapes(latent_dim)
        )

    def init_constants(self, latent_dim: int) -> Tensor:
        """Splines that are the identity, and couplings that nearly are.

        Args:
            latent_dim: size of the latent.

        Returns:
            A row of shape ``(C,)``.
        """
        parts = [torch.zeros(latent_dim * (1 + spline_size(self.num_bins)))]
        for size_in, size_out in self._shapes(latent_dim):
            bias_in, weight_in, weight_out, bias_out = self._sizes(size_in, size_out)
            parts += [
                torch.randn(bias_in),
                torch.randn(weight_in),
                0.1 * self.num_cells**-0.5 * torch.randn(weight_out),
                torch.zeros(bias_out),
            ]
        return torch.cat(parts)

    def forward(self, features: Tensor, constants: Tensor) -> CouplingFlow:
        """The flow.

        Args:
            features: of shape ``(*B, F)``.
            constants: of shape ``(C,)``.

        Returns:
            Flow with batch ``*B`` and event ``(D,)``.
        """
        dtype = torch.promote_types(features.dtype, constants.dtype)
        features, constants = features.to(dtype), constants.to(dtype)
        size = spline_size(self.num_bins)
        latent_dim = self._latent_dim(features.shape[-1])
        shapes = self._shapes(latent_dim)
        first = latent_dim * (1 + size)
        loc, own, hidden = features.split([latent_dim, first, len(shapes) * self.num_cells], dim=-1)
        sizes = [self._sizes(*shape) for shape in shapes]
        base, *weights = constants.split([first, *(size for group in sizes for size in group)], dim=-1)
        log_var, elementwise = (own + base).split([latent_dim, latent_dim * size], dim=-1)
        couplings = []
        for i, (size_in, _) in enumerate(shapes):
            bias_in, weight_in, weight_out, bias_out = weights[4 * i : 4 * i + 4]
            context = hidden[..., i * self.num_cells : (i + 1) * self.num_cells] + bias_in
            couplings.append(
                Coupling(
                    context,
                    weight_in.unflatten(-1, (size_in, self.num_cells)),
                    weight_out.unflatten(-1, (self.num_cells, -1)),
                    bias_out,
                    flip=bool(i % 2),
                )
            )
        return CouplingFlow(
            loc,
            (0.5 * soft_clamp(log_var, *self.log_var_range)).exp(),
            elementwise.unflatten(-1, (latent_dim, size)),
            couplings,
            num_points=self.num_points,
        )

    def _latent_dim(self, num_features: int) -> int:
        """The inverse of :meth:`num_features`."""
        per_dim = 2 + spline_size(self.num_bins)
        if num_features == per_dim:
            return 1
        return (num_features - self.num_layers * self.num_cells) // per_dim

    def _shapes(self, latent_dim: int) -> list[tuple[int, int]]:
        """How many dimensions decide and how many move, for every coupling."""
        if latent_dim == 1:
            return []
        half = latent_dim // 2
        return [
            (latent_dim - half, half) if i % 2 else (half, latent_dim - half) for i in range(self.num_layers)
        ]

    def _sizes(self, size_in: int, size_out: int) -> tuple[int, int, int, int]:
        """Numbers of one coupling: hidden bias, weights in and out, output bias."""
        out = size_out * spline_size(self.num_bins)
        return self.num_cells, size_in * self.num_cells, self.num_cells * out, out
