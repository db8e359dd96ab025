"""ASLFeat's detector (Luo et al., CVPR 2020, section 3.3): peakiness, its fusion, edges."""

from __future__ import annotations

import torch
from torch.nn import functional

_EDGE_STEP = 3  # pixels between the samples of the second differences that tell edges
_VALUES_AT_ONCE = {"cpu": 1 << 19, "cuda": 1 << 27}


def peakiness(features: torch.Tensor, dilation: int, scale: torch.Tensor) -> torch.Tensor:
    """How much a pixel stands out, in space and among channels, of its best channel (eq. 6 to 8).

    max over channels of softplus(y - its mean over a 3x3 neighbourhood) times
    softplus(y - its mean over the channels), where y = features / scale.

    Parameters
    ----------
    features : (C, H, W), both sides longer than the dilation; fastest in channels-last memory.
    dilation : distance of the neighbours in pixels; the map is reflected at its border.
    scale : ().

    Returns
    -------
    (H, W), at least float32.
    """
    channels, height, width = features.shape
    pixels = features.permute(1, 2, 0)
    columns = _reflected(-dilation, width + dilation, width, features.device)
    at_once = max(_VALUES_AT_ONCE[features.device.type] // (width * channels), 1)
    strips = []
    for start in range(0, height, at_once):
        stop = min(start + at_once, height)
        rows = _reflected(start - dilation, stop + dilation, height, features.device)
        padded = pixels.index_select(0, rows).index_select(1, columns)
        padded = padded.to(torch.promote_types(padded.dtype, torch.float32)) / scale
        step, number = dilation, stop - start
        inner = padded[step : step + number, step : step + width]
        three = padded[:number] + padded[step : step + number] + padded[2 * step :]
        nine = three[:, :width] + three[:, step : step + width] + three[:, 2 * step :]
        in_space = functional.softplus(inner - nine / 9)
        among_channels = functional.softplus(inner - inner.mean(dim=2, keepdim=True))
        strips.append((in_space * among_channels).amax(dim=2))
    return torch.cat(strips)


def _reflected(start: int, stop: int, size: int, device: torch.device) -> torch.Tensor:
    """Indices from start to stop of a row of some size that is mirrored at its end pixels."""
    index = torch.arange(start, stop, device=device).abs()
    return size - 1 - (size - 1 - index).abs()


def resize_as_tensorflow_1(values: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Bilinear resizing with TensorFlow 1's sampling: the first pixels lie on one another.

    Pixel i of the result lies at i * (input / output) of the input, with no half pixels; what would
    lie beyond the last row or column is that one.

    Parameters
    ----------
    values : (h, w).
    size : (H, W) of the result.
    """
    for axis, wanted in enumerate(size):
        given = values.shape[axis]
        if given == wanted:
            continue
        index = torch.arange(wanted, device=values.device, dtype=values.dtype)
        place = index * (given / wanted)
        lower = place.long().clamp(max=given - 1)
        upper = (lower + 1).clamp(max=given - 1)
        share = (place - lower).unsqueeze(1 - axis)
        first = values.index_select(axis, lower)
        values = first + (values.index_select(axis, upper) - first) * share
    return values


def on_no_edge(scores: torch.Tensor, xy: torch.Tensor, max_ratio: float) -> torch.Tensor:
    """Where the score map peaks in both directions (Lowe, IJCV 2004, section 4.1).

    Parameters
    ----------
    scores : (H, W).
    xy : int64 (N, 2), columns and rows, 3 pixels or more from the map's border.
    max_ratio : of the larger principal curvature to the smaller.

    Returns
    -------
    bool (N,).
    """
    x, y = xy.unbind(1)
    step = _EDGE_STEP

    def at(dx: int, dy: int) -> torch.Tensor:
        return scores[y + dy, x + dx]

    xx = at(step, 0) - 2 * at(0, 0) + at(-step, 0)
    yy = at(0, step) - 2 * at(0, 0) + at(0, -step)
    xy_mixed = (at(-step, -step) + at(step, step) - at(step, -step) - at(-step, step)) / 4
    determinant = xx * yy - xy_mixed * xy_mixed
    trace = xx + yy
    return (determinant > 0) & (trace * trace <= determinant * ((max_ratio + 1) ** 2 / max_ratio))
