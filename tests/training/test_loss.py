"""The transport loss: its value written out, and its gradients by finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from megloc_kapture.nets.superglue import ImageKeypoints, SuperGlueNet, log_optimal_transport
from megloc_kapture.training.labels import IGNORED, UNMATCHED, Labels
from megloc_kapture.training.networks import transport_loss

LABELS = Labels(
    np.array([2, UNMATCHED, IGNORED, 0, UNMATCHED]), np.array([3, IGNORED, 0, UNMATCHED])
)


def test_it_is_the_likelihood_of_the_labels() -> None:
    log = torch.log_softmax(torch.randn(6, 5, generator=torch.Generator().manual_seed(0)), dim=1)
    matched = (log[0, 2] + log[3, 0]) / 2
    unmatched = (log[1, 4] + log[4, 4] + log[5, 3]) / 3
    torch.testing.assert_close(transport_loss(log, LABELS), -(matched + unmatched) / 2)
    # what is ignored changes nothing
    log[2, :], log[:, 1] = 7.0, -3.0
    torch.testing.assert_close(transport_loss(log, LABELS), -(matched + unmatched) / 2)


def test_nothing_labelled_is_no_loss() -> None:
    log = torch.zeros(4, 3, requires_grad=True)
    nothing = Labels(np.full(3, IGNORED), np.full(2, IGNORED))
    assert transport_loss(log, nothing).item() == 0
    lost = Labels(np.array([UNMATCHED, IGNORED, IGNORED]), np.full(2, IGNORED))
    transport_loss(log - 2, lost).backward()
    assert log.grad is not None and log.grad.nonzero().tolist() == [[0, 2]]


@pytest.mark.parametrize("scale", [1.0, 40.0])  # the larger one rescales potentials on its way
def test_gradients_through_the_transport(scale: float) -> None:
    generator = torch.Generator().manual_seed(1)
    scores = scale * torch.randn(5, 4, generator=generator, dtype=torch.float64)
    dustbin = torch.tensor(0.3, dtype=torch.float64)

    def loss(scores: torch.Tensor, dustbin: torch.Tensor) -> torch.Tensor:
        return transport_loss(log_optimal_transport([scores], dustbin, 12)[0], LABELS)

    inputs = (scores.requires_grad_(), dustbin.requires_grad_())
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-6)


def test_gradients_through_superglue_reach_its_inputs() -> None:
    torch.manual_seed(2)
    net = SuperGlueNet(encoder_sizes=(8, 8), num_layers=2).double()
    generator = torch.Generator().manual_seed(3)

    def side(num: int) -> ImageKeypoints:
        xy = torch.rand(num, 2, generator=generator, dtype=torch.float64)
        scores = torch.rand(num, generator=generator, dtype=torch.float64)
        descriptors = torch.randn(num, 8, generator=generator, dtype=torch.float64)
        return ImageKeypoints(xy, scores, descriptors)

    a, b = side(5), side(4)

    def loss(first: torch.Tensor, second: torch.Tensor, bin_score: torch.Tensor) -> torch.Tensor:
        net.bin_score.data = bin_score.data
        pair = (
            ImageKeypoints(a.xy, a.scores, first),
            ImageKeypoints(b.xy, b.scores, second),
        )
        depths = net.assignments([pair], 10, [1, 2])
        return sum(transport_loss(depth[0], LABELS) for depth in depths)  # type: ignore[return-value]

    inputs = (a.descriptors.requires_grad_(), b.descriptors.requires_grad_(), net.bin_score.data)
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-5)
