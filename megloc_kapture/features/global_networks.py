"""Global features from networks: NetVLAD, OpenIBL, AP-GeM, DELG and MegaLoc.

Plugins of group ``megloc_kapture.global_features`` with the authors' weights: NetVLAD (Arandjelovic
et al., CVPR 2016), OpenIBL (Ge et al., ECCV 2020, "SFRS"), AP-GeM (Revaud et al., ICCV 2019), DELG
(Cao et al., ECCV 2020) and MegaLoc (Berton and Masone, CVPR Workshops 2025).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from megloc_kapture.features.network import Images
from megloc_kapture.geometry.cameras import reduced_size
from megloc_kapture.nets.delg import delg_from
from megloc_kapture.nets.global_descriptors import (
    STRIDE_PX,
    WHITENING_POWER,
    apgem_from,
    netvlad,
    openibl,
)
from megloc_kapture.nets.megaloc import PATCH_PX, megaloc_from, squared
from megloc_kapture.nets.runtime import (
    Checkpointed,
    NetworkOptions,
    image_tensor,
    inference,
    sized_tensor,
)

_OPENIBL_WIDTH_PX, _OPENIBL_HEIGHT_PX = 640, 480
_MEGALOC_SIZE_PX = 322  # side of the input image in section 4 of the paper


GlobalOptions = TypeVar("GlobalOptions", bound=NetworkOptions)


class GlobalNetwork(Checkpointed[GlobalOptions]):
    """Base of global features; the type name contains the method and the checkpoint's name."""

    name: str
    _load: Any
    _load_with: tuple[Any, ...] = ()

    def __init__(self, options: GlobalOptions | None = None) -> None:
        super().__init__(options)
        method, stem = self.name, Path(self._weights.name.removesuffix(".gz")).stem
        self.name = stem if method in stem else f"{method}-{stem}"

    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the unit-norm descriptor float32 (D,) of an RGB image uint8 (H, W, 3)."""
        return self.describe_many([image])[0]

    def describe_many(self, images: Images) -> NDArray[np.float32]:
        network, device = self.network(self._load, *self._load_with)
        batch = torch.cat([self._seen(image, device) for image in images])
        with inference(device, self.options.half_precision):
            vectors: torch.Tensor = network(batch)
            return vectors.cpu().numpy()

    def _seen(self, image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
        options: Any = self.options
        return sized_tensor(image, options.max_size_px, device)


class NetVladOptions(NetworkOptions):
    weights: str = Field(
        default="netvlad-pitts30k", description="netvlad-pitts30k, netvlad-tokyotm, or a file"
    )
    max_size_px: int = Field(
        default=1024,
        ge=STRIDE_PX,
        description="longer side of the input; smaller images are not enlarged",
    )


class NetVlad(GlobalNetwork[NetVladOptions]):
    """NetVLAD on VGG-16 with whitening: unit-norm float32 (4096,)."""

    name = "netvlad"
    Options = NetVladOptions
    _load = staticmethod(netvlad)


class OpenIblOptions(NetworkOptions):
    weights: str = Field(default="openibl", description="openibl, or a file")
    max_size_px: int | None = Field(
        default=None,
        ge=STRIDE_PX,
        description="longer side of the input, aspect ratio kept, smaller images not enlarged; "
        "none: 640 x 480 for all images, as in training",
    )


class OpenIbl(GlobalNetwork[OpenIblOptions]):
    """OpenIBL's VGG-16 with NetVLAD and PCA: unit-norm float32 (4096,)."""

    name = "openibl"
    Options = OpenIblOptions
    _load = staticmethod(openibl)

    def _seen(self, image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
        if self.options.max_size_px is None:
            return image_tensor(official_size(image), device)
        return super()._seen(image, device)


def official_size(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Resize an image as the authors do, to uint8 (480, 640, 3)."""
    return _bilinear(image, (_OPENIBL_WIDTH_PX, _OPENIBL_HEIGHT_PX))


def _bilinear(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), np.uint8)


class ApGemOptions(NetworkOptions):
    weights: str = Field(
        default="apgem-resnet101-lm18",
        description="apgem-resnet101-lm18 (Google-Landmarks), apgem-resnet101, or a file",
    )
    whitening: str = Field(
        default="Landmarks_clean",
        pattern=r"^[\w-]*$",
        description="name of a PCA whitening in the checkpoint, as in the authors' evaluation; "
        "empty: no whitening, the default of their kapture tool",
    )
    max_size_px: int | None = Field(
        default=1024,
        ge=32,
        description="longer side of the network's input, as in hloc; none: original size, as in "
        "the authors' evaluation",
    )


class ApGem(GlobalNetwork[ApGemOptions]):
    """AP-GeM: unit-norm float32 (2048,); checkpoint, whitening and power are in the type name."""

    name = "apgem"
    Options = ApGemOptions
    _load = staticmethod(apgem_from)

    def __init__(self, options: ApGemOptions | None = None) -> None:
        super().__init__(options)
        self._load_with = (self.options.whitening,)
        if self.options.whitening:
            self.name += f"-{self.options.whitening}-{WHITENING_POWER:g}"


class DelgOptions(NetworkOptions):
    weights: str = Field(
        default="delg-r101-gldv2clean",
        description="delg-{r50,r101}-{gld,gldv2clean}, or a converted file",
    )
    max_size_px: int | None = Field(
        default=1024, ge=32, description="longer side at scale 1; none: original size"
    )
    scales: tuple[float, ...] = Field(
        default=(0.70710677, 1.0, 1.4142135),
        min_length=1,
        description="image scales whose vectors are summed; the network runs once per scale",
    )


class Delg(GlobalNetwork[DelgOptions]):
    """DELG's global descriptors: unit-norm float32 (2048,)."""

    name = "delg"
    Options = DelgOptions
    _load = staticmethod(delg_from)

    def __init__(self, options: DelgOptions | None = None) -> None:
        super().__init__(options)
        self._load_with = (self.options.scales,)

    def _seen(self, image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
        height, width = image.shape[:2]
        size = reduced_size(width, height, self.options.max_size_px)
        sized = np.array(image if size == (width, height) else _bilinear(image, size))
        return torch.from_numpy(sized).to(device)[None].permute(0, 3, 1, 2).float()


class MegaLocOptions(NetworkOptions):
    weights: str = Field(default="megaloc", description="name in the registry, or a file")
    size_px: int = Field(
        default=_MEGALOC_SIZE_PX,
        ge=9 * PATCH_PX,  # 81 patches: SALAD needs more patches than its 64 clusters
        multiple_of=PATCH_PX,
        description="side of the network's square input; use the same for map and queries",
    )


class MegaLoc(GlobalNetwork[MegaLocOptions]):
    """MegaLoc on an image resized to a square, as in the paper: unit-norm float32 (8448,)."""

    name = "megaloc"
    Options = MegaLocOptions
    _load = staticmethod(megaloc_from)

    def __init__(self, options: MegaLocOptions | None = None) -> None:
        super().__init__(options)
        if self.options.size_px != _MEGALOC_SIZE_PX:
            self.name += f"-{self.options.size_px}px"

    def _seen(self, image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
        with inference(device):
            return squared(image_tensor(image, device), self.options.size_px)
