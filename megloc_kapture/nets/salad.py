"""SALAD's aggregation (Izquierdo and Civera, CVPR 2024): patches to clusters by optimal transport.

What a patch tells goes to clusters or, where it tells nothing of the place, to a dustbin.
"""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import OptionError

_ITERATIONS = 3  # the network was trained with so few


class Salad(nn.Module):
    """Features of patches and of the whole image to one vector of unit length.

    Parameters
    ----------
    channels : of the features that come in.
    clusters, cluster_size, token_size : the vector has ``token_size + cluster_size * clusters``
        components.
    hidden : width of the layer in the middle of each projection.
    """

    def __init__(
        self,
        channels: int,
        *,
        clusters: int = 64,
        cluster_size: int = 256,
        token_size: int = 256,
        hidden: int = 512,
    ) -> None:
        super().__init__()
        self.token_features = nn.Sequential(
            nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, token_size)
        )
        self.cluster_features = _per_patch(channels, hidden, cluster_size)
        self.score = _per_patch(channels, hidden, clusters)
        self.dust_bin = nn.Parameter(torch.tensor(1.0))

    def forward(self, patches: torch.Tensor, whole: torch.Tensor) -> torch.Tensor:
        """Aggregate (section 3.3 of the paper).

        Parameters
        ----------
        patches : (B, C, h, w), of more patches than there are clusters.
        whole : (B, C).

        Returns
        -------
        float32 (B, D): the image's own part first, then the clusters', the clusters running
        fastest; each of these parts was normalised before, and at last all of it.

        Raises
        ------
        OptionError : too few patches.
        """
        features = self.cluster_features(patches).flatten(2)
        # in half precision a share would keep two digits after the exponentials
        shares = assignment(self.score(patches).flatten(2).float(), self.dust_bin)
        summed = torch.matmul(features, shares.to(features).mT).float()
        summed = functional.normalize(summed, dim=1)
        token = functional.normalize(self.token_features(whole).float(), dim=1)
        return functional.normalize(torch.cat([token, summed.flatten(1)], dim=1), dim=1)


def assignment(scores: torch.Tensor, dust_bin: torch.Tensor) -> torch.Tensor:
    """Which share of each patch goes to each cluster.

    Sinkhorn's algorithm in the logarithm, three times. A patch gives the mass 1; a cluster takes
    the mass 1, the dustbin takes what is left. Unlike in SuperGlue there is no dustbin for
    clusters.

    Parameters
    ----------
    scores : (B, K, N) of K clusters and N patches, N > K.
    dust_bin : (), the score of going to the dustbin.

    Returns
    -------
    (B, K, N), at least 0; the sum over the clusters is what does not go to the dustbin.

    Raises
    ------
    OptionError : no more patches than clusters: nothing would be left for the dustbin.
    """
    batch, clusters, patches = scores.shape
    if patches <= clusters:
        raise OptionError(
            f"an image of {patches} patches is too small for {clusters} clusters; make it larger"
        )
    scores = torch.cat([scores, dust_bin.to(scores).expand(batch, 1, patches)], dim=1)
    log_taken = scores.new_zeros(clusters + 1)
    log_taken[-1] = math.log(patches - clusters)
    of_patch = scores.new_zeros(batch, 1, patches)
    for _ in range(_ITERATIONS):
        of_cluster = log_taken[:, None] - (scores + of_patch).logsumexp(2, keepdim=True)
        of_patch = -(scores + of_cluster).logsumexp(1, keepdim=True)
    return (scores + of_cluster + of_patch)[:, :-1].exp()


def _per_patch(channels: int, hidden: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, hidden, 1),
        nn.Identity(),  # in its place values are dropped out while training; it counts for the keys
        nn.ReLU(),
        nn.Conv2d(hidden, out, 1),
    )
