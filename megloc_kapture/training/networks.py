"""The networks to train, their loss, and their metrics on held-out pairs.

SuperGlue is trained on frozen features, or a descriptor network is trained with a frozen detector,
as in MegLoc (section "local features").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from megloc_kapture.errors import OptionError
from megloc_kapture.features.kornia_features import XFeat, xfeat_offset_px
from megloc_kapture.features.superpoint import (
    SuperPoint,
    SuperPointNet,
    gray_tensor,
    sample_descriptors,
)
from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.geometry.poses import rotation_angles_deg
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.matching.networks import network_input
from megloc_kapture.matching.verification import TwoViewOptions, relative_pose
from megloc_kapture.nets.kornia_networks import load_xfeat, xfeat_descriptors
from megloc_kapture.nets.runtime import image_tensor, load_strictly
from megloc_kapture.nets.superglue import (
    ImageKeypoints,
    SuperGlueNet,
    log_optimal_transport,
    mutual_matches,
)
from megloc_kapture.plugins import LocalFeatureExtractor
from megloc_kapture.training.labels import IGNORED, UNMATCHED, Labels
from megloc_kapture.training.pairs import TrainingPair
from megloc_kapture.values import ImageFeatures, RigidTransform

_FIRST_SCALE = 10.0  # initial scale of descriptor products
_FIRST_DUSTBIN = 0.7  # initial cosine of the dustbin
_CONFIDENT = 0.2  # SuperGlue's threshold on the scores of matches

Image = NDArray[np.uint8]
AUC_DEG = (5, 10, 20)
_TWO_VIEWS = TwoViewOptions(max_error_px=2.0)
_SAME_CENTRE = 1e-9


@dataclass(frozen=True, eq=False)
class PreparedPair:
    pair: TrainingPair
    features: tuple[ImageFeatures, ImageFeatures]
    labels: Labels

    @property
    def usable(self) -> bool:
        return all(len(image.keypoints_px) > 0 for image in self.features)


class SuperPointDescriber(nn.Module):
    """SuperPoint's backbone and descriptor head, which ``descriptor_weights`` loads."""

    def __init__(self, extractor: SuperPoint) -> None:
        super().__init__()
        self.options = options = extractor.options
        tensors = read_weights(find_weights(options.weights))
        if options.descriptor_weights is not None:
            tensors |= read_weights(find_weights(options.descriptor_weights))
        described = {key: value for key, value in tensors.items() if not key.startswith("convP")}
        self.net = load_strictly(SuperPointNet(detector=False), described, options.weights)

    def forward(self, image: Image, xy_px: torch.Tensor) -> torch.Tensor:
        dense = self.net.describe(self.net.encode(gray_tensor(image, xy_px.device)))
        return sample_descriptors(dense[0], xy_px - 0.5, self.options.descriptor_sampling)


class XFeatDescriber(nn.Module):
    """XFeat's descriptor network with frozen normalisation statistics, since batches are small."""

    def __init__(self, extractor: XFeat) -> None:
        super().__init__()
        name = extractor.options.descriptor_weights or extractor.options.weights
        network: Any = load_xfeat(read_weights(find_weights(name)), name)
        # channels last as in inference, since it is faster on a CPU
        self._network = network.to(memory_format=torch.channels_last)
        self.net = network.net
        for part in (self.net.heatmap_head, self.net.keypoint_head, self.net.fine_matcher):
            part.requires_grad_(False)

    def train(self, mode: bool = True) -> XFeatDescriber:
        super().train(False)
        return self

    def forward(self, image: Image, xy_px: torch.Tensor) -> torch.Tensor:
        xy = xy_px - torch.from_numpy(xfeat_offset_px(image.shape)).to(xy_px)
        return xfeat_descriptors(self._network, image_tensor(image, xy_px.device), xy)


def describer_of(extractor: LocalFeatureExtractor) -> SuperPointDescriber | XFeatDescriber:
    """Return the descriptor network of an extractor."""
    if isinstance(extractor, SuperPoint):
        return SuperPointDescriber(extractor)
    if isinstance(extractor, XFeat):
        return XFeatDescriber(extractor)
    raise OptionError(
        f"only descriptors of superpoint and xfeat can be trained, not those of {extractor.name}"
    )


class ProductHead(nn.Module):
    """Matching by dot products of descriptors, with learned scale and dustbin for training only."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(_FIRST_SCALE))
        self.dustbin = nn.Parameter(torch.tensor(_FIRST_DUSTBIN))

    def forward(
        self, pairs: Sequence[tuple[ImageKeypoints, ImageKeypoints]], iterations: int
    ) -> list[torch.Tensor]:
        cosines = (a.descriptors.float() @ b.descriptors.float().T for a, b in pairs)
        products = [self.scale * cosine for cosine in cosines]
        return log_optimal_transport(products, self.scale * self.dustbin, iterations)


@torch.no_grad()
def begin_at_products(net: SuperGlueNet) -> None:
    """Initialise a new SuperGlue to match by products of descriptors, as :class:`ProductHead` does.

    The last layers of the keypoint encoder and of the message networks are zeroed, like residual
    branches that begin at zero (Bachlechner et al., UAI 2021). The final projection is a scaled
    identity.
    """
    perceptrons = [module for module in net.modules() if isinstance(module, nn.Sequential)]
    for last in (net.final_proj, *(perceptron[-1] for perceptron in perceptrons)):
        for parameter in last.parameters():
            parameter.zero_()
    size = net.descriptor_size
    scale = (_FIRST_SCALE * size**0.5) ** 0.5  # products are divided by the root of the size
    net.final_proj.weight.copy_(scale * torch.eye(size)[:, :, None])
    net.bin_score.fill_(_FIRST_SCALE * _FIRST_DUSTBIN)


def encoder_sizes(descriptor_size: int) -> tuple[int, ...]:
    """Return the layer sizes of SuperGlue's keypoint encoder, in the official proportions."""
    if descriptor_size % 8:
        raise OptionError(
            f"SuperGlue needs a descriptor size that is a multiple of 8, not {descriptor_size}"
        )
    return tuple(descriptor_size // part for part in (8, 4, 2, 1, 1))


class PairModel(nn.Module):
    """A matcher and an optional descriptor network (None: frozen descriptors) as one module.

    ``iterations`` are those of the optimal transport.
    """

    def __init__(
        self,
        head: SuperGlueNet | ProductHead,
        describer: SuperPointDescriber | XFeatDescriber | None,
        *,
        iterations: int,
    ) -> None:
        super().__init__()
        self.head, self.describer, self._iterations = head, describer, iterations

    def forward(self, pairs: Sequence[PreparedPair]) -> torch.Tensor:
        """Return the mean loss, a scalar; a pair with an image without keypoints counts as 0."""
        usable = [pair for pair in pairs if pair.usable]
        if not usable:
            return 0.0 * next(self.head.parameters()).sum()
        losses = [
            transport_loss(assignment, pair.labels)
            for pair, assignment in zip(usable, self._assignments(usable), strict=True)
        ]
        return torch.stack(losses).sum() / len(pairs)

    @torch.no_grad()
    def match(self, pair: PreparedPair) -> tuple[NDArray[np.int64], float]:
        """Return matches (K, 2) and the loss of a pair."""
        if not pair.usable:
            return np.zeros((0, 2), np.int64), 0.0
        (assignment,) = self._assignments([pair])
        threshold = _CONFIDENT if isinstance(self.head, SuperGlueNet) else 0.0
        matches, _ = mutual_matches(assignment, threshold)
        return matches.cpu().numpy(), float(transport_loss(assignment, pair.labels))

    def _assignments(self, pairs: Sequence[PreparedPair]) -> list[torch.Tensor]:
        sides = [(self._side(pair, 0), self._side(pair, 1)) for pair in pairs]
        assignments: list[torch.Tensor] = self.head(sides, self._iterations)
        return assignments

    def _side(self, prepared: PreparedPair, side: int) -> ImageKeypoints:
        features = prepared.features[side]
        device = next(self.head.parameters()).device
        keypoints = network_input(features, features.descriptors.shape[1], "SuperGlue", device)
        if self.describer is None:
            return keypoints
        xy_px = torch.from_numpy(features.keypoints_px[:, :2].copy()).to(device)
        return replace(keypoints, descriptors=self.describer(prepared.pair.images[side], xy_px))


def transport_loss(log_assignment: torch.Tensor, labels: Labels) -> torch.Tensor:
    """Return the scalar negative log likelihood of labels for log assignments (N + 1, M + 1).

    This is SuperGlue's equation 10, but with equal weights for the mean over matched and the mean
    over unmatched keypoints, as in LightGlue's equation 9. Ignored keypoints do not count.
    """
    device = log_assignment.device
    rows, columns = torch.from_numpy(labels.matches()).to(device).T
    lost_a = torch.from_numpy(labels.partner_a == UNMATCHED).to(device)
    lost_b = torch.from_numpy(labels.partner_b == UNMATCHED).to(device)
    matched = log_assignment[rows, columns]
    unmatched = torch.cat([log_assignment[:-1, -1][lost_a], log_assignment[-1, :-1][lost_b]])
    return -sum(0.5 * part.sum() / max(len(part), 1) for part in (matched, unmatched))  # type: ignore[return-value]


@dataclass(frozen=True)
class HeldOutResult:
    pairs: int
    loss: float  # mean over the pairs
    precision: float  # share of correct matches among those with a labelled keypoint
    recall: float  # share of the labelled matches that the network returns
    # area under the recall curve of the relative pose error up to 5, 10 and 20 degrees, in [0, 1]
    auc: tuple[float, ...]


def held_out_result(model: PairModel, pairs: Sequence[PreparedPair]) -> HeldOutResult:
    right = judged_count = labelled = 0
    losses, errors = [], []
    for pair in pairs:
        matches, loss = model.match(pair)
        good, known = judged(matches, pair.labels)
        right, judged_count = right + int(good.sum()), judged_count + int(known.sum())
        labelled += len(pair.labels.matches())
        losses.append(loss)
        if pair.pair.views is not None:
            errors.append(pose_error_deg(pair, matches))
    loss = float(np.mean(losses)) if losses else 0.0
    precision, recall = right / max(judged_count, 1), right / max(labelled, 1)
    return HeldOutResult(len(pairs), loss, precision, recall, pose_auc(errors))


def judged(
    matches: NDArray[np.int64], labels: Labels
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks (K,) of correct matches and of matches with a labelled keypoint."""
    a, b = labels.partner_a[matches[:, 0]], labels.partner_b[matches[:, 1]]
    return a == matches[:, 1], (a != IGNORED) | (b != IGNORED)


def pose_error_deg(pair: PreparedPair, matches: NDArray[np.int64]) -> float:
    """Return the larger of the errors of rotation and translation direction, in degrees.

    As in SuperGlue's evaluation, the sign of the translation is ignored. Without a baseline, only
    the rotation counts. If no pose is estimated, the error is infinite.
    """
    views = pair.pair.views
    assert views is not None
    truth = views[1].cam_from_world @ views[0].cam_from_world.inverse()
    rays = [
        bearing_rays(view.camera, features.keypoints_px[matches[:, side], :2])
        for side, (view, features) in enumerate(zip(views, pair.features, strict=True))
    ]
    usable = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
    focal = 0.5 * (focal_px(views[0].camera) + focal_px(views[1].camera))
    estimate = relative_pose(rays[0][usable], rays[1][usable], focal, _TWO_VIEWS, min_matches=6)
    return np.inf if estimate is None else relative_pose_error_deg(estimate, truth)


def relative_pose_error_deg(estimate: RigidTransform, truth: RigidTransform) -> float:
    rotation = rotation_angles_deg(np.array(estimate.quat_wxyz), np.array(truth.quat_wxyz))
    a, b = np.array(estimate.translation), np.array(truth.translation)
    lengths = np.linalg.norm(a) * np.linalg.norm(b)
    if np.linalg.norm(b) < _SAME_CENTRE or lengths == 0:
        return float(rotation)
    translation = np.degrees(np.arccos(min(1.0, abs(a @ b) / lengths)))
    return float(max(rotation, translation))


def pose_auc(errors_deg: Sequence[float] | NDArray[Any]) -> tuple[float, ...]:
    """Return the normalised area under the recall curve up to each of AUC_DEG."""
    ascending = np.sort(np.asarray(errors_deg, np.float64))
    if not len(ascending):
        return (0.0,) * len(AUC_DEG)
    recall = np.arange(1, len(ascending) + 1) / len(ascending)
    areas = []
    for bound in AUC_DEG:
        inside = np.searchsorted(ascending, bound)
        x = np.concatenate([[0.0], ascending[:inside], [bound]])
        y = np.concatenate([[0.0], recall[:inside], recall[inside - 1 : inside] if inside else [0]])
        areas.append(float(np.trapezoid(y, x) / bound))
    return tuple(areas)
