"""Optimal transport with dustbins (Sarlin et al., SuperGlue, CVPR 2020, section 3.2).

Sinkhorn's algorithm is defined in the logarithm, where nothing overflows, and costs an exponential
per entry and half step there. Here the two potentials are kept in the logarithm and everything
between is a matrix-vector product: exp(Z + u + v) is made once, its rows and columns are scaled,
and the scales go into the potentials before they grow (Schmitzer, "Stabilized sparse scaling
algorithms", SIAM J. Sci. Comput. 2019, section 3.1). One iteration in the logarithm comes first.
After it a half step changes no scale by more than a factor N + M, so that with the bounds below no
product overflows, and what is left out of a sum is less than 1e-7 of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.nn import functional

_LARGEST_SCALE = 2.0e4  # beyond it, or below its inverse, scales go into the potentials
_SMALLEST_ENTRY = 1e-30  # of the kernel; its products stay normal numbers, which are fast
_PADDING = -1e30  # nothing, but with a gradient


def log_optimal_transport(
    scores: Sequence[torch.Tensor], bin_score: torch.Tensor, iterations: int
) -> list[torch.Tensor]:
    """Logarithms of partial assignments, by Sinkhorn's algorithm.

    Parameters
    ----------
    scores : matrices (N, M) of any sizes, N and M at least 1, all float32 or all float64.
    bin_score : (), the score of matching nothing.
    iterations : at least 1; each normalises the rows, then the columns.

    Returns
    -------
    For each matrix (N + 1, M + 1), the dustbins last. The exponential sums to 1 over every row and
    column but the dustbins', which sum to M over the row and to N over the column.
    """
    like = scores[0]
    rows, columns = max(s.shape[0] for s in scores), max(s.shape[1] for s in scores)
    couplings = like.new_full((len(scores), rows + 1, columns + 1), _PADDING)
    row_mass = like.new_zeros((len(scores), rows + 1))
    column_mass = like.new_zeros((len(scores), columns + 1))
    for k, matrix in enumerate(scores):
        n, m = matrix.shape
        couplings[k, : n + 1, : m + 1] = bin_score
        couplings[k, :n, :m] = matrix
        row_mass[k, :n], row_mass[k, n] = 1, m
        column_mass[k, :m], column_mass[k, m] = 1, n
    total = row_mass.sum(dim=1, keepdim=True)
    u, v = _potentials(couplings, row_mass / total, column_mass / total, iterations)
    u = u + total.log()
    whole = ((couplings + u[:, :, None]) + v[:, None, :]).to(like.dtype)
    return [whole[k, : len(matrix) + 1, : matrix.shape[1] + 1] for k, matrix in enumerate(scores)]


def _potentials(
    couplings: torch.Tensor, row_mass: torch.Tensor, column_mass: torch.Tensor, iterations: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """u (B, N + 1) and v (B, M + 1), float64, such that exp(Z + u + v) has the masses.

    Both are 0 at padding, where there is no mass.
    """
    # added there: 0 / (0 + 1) is no scale, and log(0 + 1) no potential
    row_padding = (row_mass == 0).to(couplings.dtype)
    column_padding = (column_mass == 0).to(couplings.dtype)

    def potential(mass: torch.Tensor, log_sum: torch.Tensor) -> torch.Tensor:
        return (mass.double().log() - log_sum).masked_fill(mass == 0, 0.0)

    u = potential(row_mass, couplings.logsumexp(dim=2))
    v = potential(column_mass, (couplings + u[:, :, None]).logsumexp(dim=1))
    kernel = _kernel(couplings, u, v)
    row_scale, column_scale = torch.ones_like(row_mass), torch.ones_like(column_mass)
    for _ in range(iterations - 1):
        sums = torch.matmul(kernel, column_scale[:, :, None])[:, :, 0]
        row_scale = row_mass / (sums + row_padding)
        sums = torch.matmul(row_scale[:, None, :], kernel)[:, 0]
        column_scale = column_mass / (sums + column_padding)
        if _extreme(row_scale + row_padding, column_scale + column_padding):
            u = u + (row_scale + row_padding).double().log()
            v = v + (column_scale + column_padding).double().log()
            kernel = _kernel(couplings, u, v)
            row_scale, column_scale = torch.ones_like(row_mass), torch.ones_like(column_mass)
    u = u + (row_scale + row_padding).double().log()
    return u, v + (column_scale + column_padding).double().log()


def _kernel(couplings: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    # scores in the hundreds and their potentials cancel: float32 would keep four digits
    exponents = (couplings + u[:, :, None]) + v[:, None, :]
    return functional.threshold(exponents.to(couplings.dtype).exp(), _SMALLEST_ENTRY, 0.0)


def _extreme(row_scale: torch.Tensor, column_scale: torch.Tensor) -> bool:
    smallest, largest = torch.aminmax(torch.cat([row_scale, column_scale], dim=1))
    return bool((largest > _LARGEST_SCALE) | (smallest < 1 / _LARGEST_SCALE))
