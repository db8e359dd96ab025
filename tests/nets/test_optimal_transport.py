"""Optimal transport against transformers' log-domain iterations, its marginals and symmetries."""

from __future__ import annotations

import math

import pytest
import torch
from transformers.models.superglue.modeling_superglue import log_optimal_transport as in_logarithm

from megloc_kapture.nets.optimal_transport import log_optimal_transport

BIN = torch.tensor(1.0)


def random_scores(rows: int, columns: int, scale: float, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn((rows, columns), generator=generator)


def definition(scores: torch.Tensor, bin_score: torch.Tensor, iterations: int) -> torch.Tensor:
    return in_logarithm(scores[None].double(), bin_score.double(), iterations)[0]


# up to 300: scores beyond a thousand, where an exponential alone over- and underflows
@pytest.mark.parametrize("iterations", [1, 2, 7, 100])
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0, 50.0, 300.0])
@pytest.mark.parametrize("bin_score", [-300.0, 2.3, 300.0])
def test_it_is_the_log_domain_definition(scale: float, iterations: int, bin_score: float) -> None:
    scores, dustbin = random_scores(60, 45, scale), torch.tensor(bin_score)
    expected = definition(scores, dustbin, iterations)
    exactly = log_optimal_transport([scores.double()], dustbin.double(), iterations)[0]
    torch.testing.assert_close(exactly, expected, rtol=1e-12, atol=1e-9)
    found = log_optimal_transport([scores], dustbin, iterations)[0]
    assert found.dtype == torch.float32
    # of the result: its logarithm to the last bits of a number of its size, confidences to 1e-5
    torch.testing.assert_close(found.double(), expected, rtol=3e-7, atol=3e-5)
    inner = found[:-1, :-1].double().exp()
    torch.testing.assert_close(inner, expected[:-1, :-1].exp(), rtol=0, atol=1e-5)


def test_scores_of_one_sure_assignment() -> None:
    generator = torch.Generator().manual_seed(1)
    partner = torch.randperm(80, generator=generator)
    scores = torch.full((80, 80), -400.0)
    scores[torch.arange(80), partner] = 400.0
    found = log_optimal_transport([scores], BIN, 100)[0]
    torch.testing.assert_close(
        found.double().exp(), definition(scores, BIN, 100).exp(), rtol=0, atol=1e-5
    )
    assert found[:-1, :-1].argmax(dim=1).tolist() == partner.tolist()


def test_marginals() -> None:
    rows, columns = 70, 50
    plan = log_optimal_transport([random_scores(rows, columns, 2.0)], BIN, 100)[0].exp()
    ones = torch.ones
    torch.testing.assert_close(plan.sum(1)[:-1], ones(rows), rtol=0, atol=1e-3)
    torch.testing.assert_close(plan.sum(0)[:-1], ones(columns), rtol=0, atol=1e-3)
    assert plan.sum(1)[-1] == pytest.approx(columns, abs=1e-3)
    assert plan.sum(0)[-1] == pytest.approx(rows, abs=1e-3)


def test_equal_scores_without_dustbins_are_equal_shares() -> None:
    inner = log_optimal_transport([torch.zeros(40, 40)], torch.tensor(-1e4), 100)[0][:-1, :-1]
    assert inner.max() - inner.min() < 1e-6
    # such a dustbin empties as slowly as one over the number of iterations
    assert inner.mean() == pytest.approx(-math.log(40.0), abs=0.01)


def test_the_order_of_keypoints_does_not_matter() -> None:
    scores = random_scores(30, 40, 5.0)
    rows, columns = torch.randperm(30), torch.randperm(40)
    found = log_optimal_transport([scores], BIN, 50)[0]
    shuffled = log_optimal_transport([scores[rows][:, columns]], BIN, 50)[0]
    torch.testing.assert_close(shuffled[:-1, :-1], found[rows][:, columns], rtol=1e-5, atol=1e-4)


def test_a_batch_of_any_sizes_is_one_after_the_other() -> None:
    matrices = [
        random_scores(50, 20, 3.0, 1),
        random_scores(1, 1, 1.0, 2),
        random_scores(7, 64, 200.0, 3),  # its scales go into the potentials, the others' not
        random_scores(33, 33, 0.5, 4),
    ]
    together = log_optimal_transport(matrices, BIN, 100)
    for matrix, found in zip(matrices, together, strict=True):
        alone = log_optimal_transport([matrix], BIN, 100)[0]
        assert found.shape == alone.shape == (matrix.shape[0] + 1, matrix.shape[1] + 1)
        torch.testing.assert_close(found, alone, rtol=3e-7, atol=3e-5)


def test_gradients_are_those_of_the_definition() -> None:
    scores = random_scores(6, 5, 2.0).double().requires_grad_()
    padded_by = random_scores(9, 7, 2.0).double()
    dustbin = torch.tensor(0.7).double().requires_grad_()
    log_optimal_transport([padded_by, scores], dustbin, 30)[1][2, 3].backward()
    found = scores.grad
    assert found is not None
    again = scores.detach().clone().requires_grad_()
    in_logarithm(again[None], dustbin.detach(), 30)[0][2, 3].backward()
    torch.testing.assert_close(found, again.grad, rtol=1e-6, atol=1e-9)
