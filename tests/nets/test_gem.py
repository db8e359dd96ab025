"""Generalized-mean pooling against its definition and its limits."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from megloc_kapture.nets.gem import generalized_mean


@pytest.mark.parametrize("power", [0.5, 1.0, 2.7, 3.0])
def test_definition(power: float) -> None:
    features = np.random.default_rng(0).uniform(0, 3, (2, 5, 4, 7))
    expected = np.zeros((2, 5))
    for image, channel in np.ndindex(2, 5):
        places = features[image, channel].ravel()
        expected[image, channel] = (sum(x**power for x in places) / len(places)) ** (1 / power)
    found = generalized_mean(torch.from_numpy(features), power)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_mean_and_maximum_are_its_limits() -> None:
    features = torch.rand(3, 6, 5, 8, dtype=torch.float64, generator=torch.manual_seed(0))
    torch.testing.assert_close(generalized_mean(features, 1.0), features.mean(dim=(2, 3)))
    largest = features.amax(dim=(2, 3))
    for power in (3.0, 30.0, 300.0):
        found = generalized_mean(features, power)
        # of 40 places at least one has the largest value
        least = largest * 40 ** (-1 / power)
        assert (found <= largest).all() and (found >= least).all()
    torch.testing.assert_close(found, largest, rtol=0.02, atol=0)


def test_a_learnt_power_of_shape_one() -> None:
    features = torch.rand(2, 3, 4, 4)
    torch.testing.assert_close(
        generalized_mean(features, torch.tensor([2.5])), generalized_mean(features, 2.5)
    )


def test_nothing_below_the_minimum() -> None:
    features = torch.tensor([-5.0, 0.0, 1e-9]).view(1, 1, 1, 3)
    torch.testing.assert_close(generalized_mean(features, 3.0), torch.tensor([[1e-6]]))


def test_half_precision_does_not_overflow() -> None:
    features = torch.full((1, 1, 2, 2), 500.0, dtype=torch.float16)
    found = generalized_mean(features, 3.0)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, torch.tensor([[500.0]]))
