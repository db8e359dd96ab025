"""The loss of a matcher: likelihood of the labels under the optimal transport."""

from __future__ import annotations

import torch

from megloc_kapture.training.labels import UNMATCHED, Labels


def transport_loss(log_assignment: torch.Tensor, labels: Labels) -> torch.Tensor:
    """Negative log likelihood of labels; ignored keypoints do not count.

    SuperGlue's equation 10 (Sarlin et al., CVPR 2020), with the means of the matched and of the
    unmatched keypoints weighted alike, as LightGlue does (Lindenberger et al., ICCV 2023, equation
    9): how many there are of each depends on the images.

    Parameters
    ----------
    log_assignment : (N + 1, M + 1), logarithms, the dustbins last.
    labels : of the N and M keypoints.

    Returns
    -------
    (), 0 where nothing is labelled.
    """
    device = log_assignment.device
    rows, columns = torch.from_numpy(labels.matches()).to(device).T
    lost_a = torch.from_numpy(labels.partner_a == UNMATCHED).to(device)
    lost_b = torch.from_numpy(labels.partner_b == UNMATCHED).to(device)
    matched = log_assignment[rows, columns]
    unmatched = torch.cat([log_assignment[:-1, -1][lost_a], log_assignment[-1, :-1][lost_b]])
    # a mean of nothing is not a number
    return -sum(0.5 * part.sum() / max(len(part), 1) for part in (matched, unmatched))  # type: ignore[return-value]
