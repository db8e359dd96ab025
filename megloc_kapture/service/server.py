"""Start of the service: load the networks, listen, and prepare a top view of the map."""

from __future__ import annotations

import json
import logging
import socket

import cv2
import numpy as np
import uvicorn
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.service.app import Service, make_app
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import Camera

_MAX_POINTS, _MAX_CAMERAS = 15_000, 3_000
_SHUTDOWN_S = 60  # running requests may finish within this time; slow uploads are cut off


def prepared_localizer(kapture_map: KaptureMap, options: PipelineOptions) -> Localizer:
    """Return a localizer with loaded networks, so that missing files are reported at once."""
    localizer = Localizer(kapture_map, options=options)
    kapture_map.check()
    for local in localizer.types:
        _ = local.extractor
    # noise gets no pose, but loads the networks of features, retrieval and matching
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    with single_threaded():
        localizer.localize(noise, Camera.pinhole(320, 240, 300.0))
    return localizer


def bind(host: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 picks a free port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        raise OptionError(f"cannot listen at {host}, port {port}: {error}") from error


def serve(service: Service, bound: socket.socket, *, log_requests: bool = False) -> None:
    """Serve until SIGTERM or SIGINT; running requests may finish."""
    logging.getLogger("uvicorn").setLevel(logging.ERROR)
    cv2.setNumThreads(1)  # several images are localized in parallel instead
    app = make_app(service, map_overview(service.localizer.map))
    config = uvicorn.Config(
        app,
        ws="none",
        log_config=None,
        access_log=log_requests,
        server_header=False,
        timeout_graceful_shutdown=_SHUTDOWN_S,
    )
    with single_threaded():
        uvicorn.Server(config).run([bound])


def map_overview(kapture_map: KaptureMap) -> bytes:
    """Return a top view of the map as JSON.

    The world vectors ``right`` and ``up`` and the world point ``origin`` define the coordinates of
    the view. ``points`` [x, y, ...] and ``cameras`` [x, y, direction x, direction y, ...] are in
    these coordinates, and subsampled if there are many. ``images`` is the number of map images,
    ``unit`` is ``m`` or ``units``.
    """
    from megloc_kapture.evaluation.report.queries import top_view

    names = kapture_map.images
    quats, translations = stack_poses([kapture_map.poses[name] for name in names])
    centers = camera_centers(quats, translations)
    origin = centers.mean(axis=0)
    axes, _ = top_view(quats, centers)
    forward = rotate(invert_quats(quats), np.array([0.0, 0.0, 1.0]))
    cameras = np.hstack([(centers - origin) @ axes.T, forward @ axes.T])
    points = _without_outliers(
        np.concatenate([k.index.xyz for k in kapture_map.keypoints.values()])
    )
    content = {
        "images": len(names),
        "unit": kapture_map.unit,
        "right": _rounded(axes[0], 9),
        "up": _rounded(axes[1], 9),
        "origin": origin.tolist(),
        "cameras": _rounded(cameras[:: 1 + len(cameras) // _MAX_CAMERAS]),
        "points": _rounded((points[:: 1 + len(points) // _MAX_POINTS] - origin) @ axes.T),
    }
    return json.dumps(content, separators=(",", ":")).encode()


def _without_outliers(points: NDArray[np.float64]) -> NDArray[np.float64]:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        return points
    low, high = np.percentile(points, [1.0, 99.0], axis=0)
    margin = 0.5 * (high - low)
    return points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]


def _rounded(values: NDArray[np.float64], digits: int = 5) -> list[float]:
    return [float(f"{value:.{digits}g}") for value in values.ravel().tolist()]
