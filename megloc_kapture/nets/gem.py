"""Generalized-mean pooling (Radenovic et al., TPAMI 2018, equation 3)."""

from __future__ import annotations

import torch

# smaller activations count as this, so that powers and their gradients stay finite
MINIMUM = 1e-6


def generalized_mean(features: torch.Tensor, power: torch.Tensor | float) -> torch.Tensor:
    """The power mean of each channel over all places: 1 is the mean, infinity the maximum.

    Parameters
    ----------
    features : (B, C, H, W), of any precision; what is below 1e-6 counts as 1e-6.
    power : one number, not 0.

    Returns
    -------
    float32 (B, C); float64 where the features are.
    """
    # a third power leaves the range of half precision at 41
    values = features if features.dtype == torch.float64 else features.float()
    return values.clamp(min=MINIMUM).pow(power).mean(dim=(2, 3)).pow(1.0 / power)
