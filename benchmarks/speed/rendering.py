"""Refinement by rendering on the synthetic world: error before and after, and seconds per query.

    python benchmarks/speed/rendering.py [--worlds 3] [--starts 3] [--limit-s 0.5]

Queries of 640x480 that the map does not copy, in worlds of several seeds, from starts that are off
by 10 cm and 2 deg in random directions. Each query is taken by day; with the day's light but a
night camera's gain, colours and noise; the same with 30 % of its view behind something that moves;
and at night, where lamps stand for the sun and gain and bias no longer tell the difference. Seconds
are wall time, warm, with the library's own two threads; reading images is not in them. "chi2" is
the median of the squared error over the claimed covariance per degree of freedom: 0.9 where it is
right. With ``--limit-s`` the script fails where the median takes longer.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from timing import table  # noqa: E402

from megloc_kapture.datasets.synthetic.covisibility import overlap  # noqa: E402
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions  # noqa: E402
from megloc_kapture.datasets.synthetic.shots import Shot  # noqa: E402
from megloc_kapture.datasets.synthetic.views import PlacePainter  # noqa: E402
from megloc_kapture.datasets.synthetic.world import build_world  # noqa: E402
from megloc_kapture.geometry.poses import rotation_angles_deg  # noqa: E402
from megloc_kapture.plugins import DepthView, PoseRefinement  # noqa: E402
from megloc_kapture.refinement.photometric import perturbed  # noqa: E402
from megloc_kapture.refinement.rendering import (  # noqa: E402
    RenderingOptions,
    RenderingQuery,
    RenderingReference,
    refine_by_rendering,
)
from megloc_kapture.values import RigidTransform  # noqa: E402

OFF_M, OFF_DEG = 0.10, 2.0
GOOD_M, GOOD_DEG = 0.005, 0.1


@dataclass
class Results:
    """Of one kind of query: errors (m, deg) before and after, and the rest by run."""

    before: list[tuple[float, float]] = field(default_factory=list)
    after: list[tuple[float, float]] = field(default_factory=list)
    accepted: list[bool] = field(default_factory=list)
    chi2: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def row(self, name: str) -> list[str]:
        before, after = np.array(self.before), np.array(self.after)
        good = (after <= (GOOD_M, GOOD_DEG)).all(1)
        middle, late = np.percentile(after, (50, 90), axis=0)
        p50, p95 = np.percentile(self.seconds, (50, 95))
        return [
            name,
            f"{len(after)}",
            "{:.0f} mm {:.2f} deg".format(*(np.median(before, axis=0) * (1e3, 1))),
            "{:.1f} mm {:.3f} deg".format(*(middle * (1e3, 1))),
            "{:.1f} mm {:.3f} deg".format(*(late * (1e3, 1))),
            f"{good.mean():.2f}",
            f"{np.mean(self.accepted):.2f}",
            f"{np.median(self.chi2):.2f}" if self.chi2 else "-",
            f"{p50:.2f}",
            f"{p95:.2f}",
        ]


def darkened(shot: Shot) -> Shot:
    """The shot in its own light by a camera with a night's gain, colours and noise."""
    look = shot.look
    red, green, blue = look.white_balance
    night = replace(
        look,
        exposure=0.2 * look.exposure,
        white_balance=(1.1 * red, 0.92 * green, 0.75 * blue),
        shot_noise=2.2e-3,
        read_noise=0.006,
        blur_px=0.9,
        vignetting=0.3,
    )
    return replace(shot, look=night)


def occluded(image: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """Something with a texture of its own in front of 30 % of the view."""
    rng = np.random.default_rng(seed)
    height, width = image.shape[:2]
    left, top = int(rng.uniform(0, 0.5) * width), int(rng.uniform(0, 0.4) * height)
    noise = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), 3)
    cloth = np.clip(90 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    result = image.copy()
    where = np.s_[top : top + round(0.6 * height), left : left + round(0.5 * width)]
    result[where] = cloth[where]
    return result


def cases(
    seed: int, max_references: int
) -> Iterator[tuple[str, RenderingQuery, list[RenderingReference], RigidTransform]]:
    """Kind, query, references and true pose."""
    options = SyntheticWorldOptions(seed=seed, num_places=1, day_queries=6, night_queries=6)
    world = build_world(options)
    painter = PlacePainter(world.places[0], seed=seed, supersampling=options.supersampling)
    views = world.coarse_views()
    drawn: dict[str, RenderingReference] = {}
    for number, query in enumerate(world.queries):
        shares = {shot.name: overlap(views[query.name], views[shot.name]) for shot in world.mapping}
        near = sorted(world.mapping, key=lambda shot: -shares[shot.name])[:max_references]
        for shot in near:
            if shot.name not in drawn:
                view = painter.draw(shot, depth=True)
                if view.depth_m is None:
                    raise RuntimeError(f"{shot.name} was drawn without depth")
                depth = DepthView(shot.camera, view.depth_m, RigidTransform.identity())
                drawn[shot.name] = RenderingReference(
                    view.image, shot.camera, shot.cam_from_world, depth, view.mask
                )
        images = {query.condition: painter.draw(query).image}
        if query.condition == "day":
            dark = painter.draw(darkened(query)).image
            images["gain, colour, noise"] = dark
            images["the same, 30 % hidden"] = occluded(dark, 100 * seed + number)
        references = [drawn[shot.name] for shot in near]
        for kind, image in images.items():
            yield kind, RenderingQuery(image, query.camera), references, query.cam_from_world


def start_from(truth: RigidTransform, seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=3), rng.normal(size=3)
    turn = np.radians(OFF_DEG) * axis / np.linalg.norm(axis)
    turned = perturbed(truth, np.concatenate([turn, np.zeros(3)]))
    # a rotation about the world's origin moves the centre: put it where it belongs
    center = truth.center() + OFF_M * shift / np.linalg.norm(shift)
    rotation = turned.rotation_matrix()
    return RigidTransform.from_matrix(rotation, -rotation @ center)


def errors(pose: RigidTransform, truth: RigidTransform) -> tuple[float, float]:
    angle = rotation_angles_deg(np.array(pose.quat_wxyz), np.array(truth.quat_wxyz))
    return float(np.linalg.norm(pose.center() - truth.center())), float(angle)


def chi2_per_degree(refined: PoseRefinement, truth: RigidTransform) -> float:
    true_from_found = truth @ refined.cam_from_world.inverse()
    w, x, y, z = true_from_found.quat_wxyz
    turn = 2.0 * np.sign(w) * np.array([x, y, z])
    vector = np.concatenate([turn, true_from_found.translation])
    return float(vector @ np.linalg.solve(np.asarray(refined.covariance), vector)) / 6.0


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=3, help="seeds of the synthetic world")
    parser.add_argument("--starts", type=int, default=3, help="starts per query")
    parser.add_argument("--max-points", type=int, help="of a reference and level")
    parser.add_argument("--limit-s", type=float, help="fail where the median query takes longer")
    given = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    options = RenderingOptions()
    if given.max_points is not None:
        options = RenderingOptions(max_points=given.max_points)
    results: dict[str, Results] = {}
    warm = False
    for seed in range(given.worlds):
        for kind, query, references, truth in cases(seed, options.max_references):
            if not warm:  # the first call compiles
                refine_by_rendering(query, references, start_from(truth, 0), options)
                warm = True
            result = results.setdefault(kind, Results())
            for number in range(given.starts):
                start = start_from(truth, 1000 * number + seed)
                begun = time.perf_counter()
                refined = refine_by_rendering(query, references, start, options)
                result.seconds.append(time.perf_counter() - begun)
                result.before.append(errors(start, truth))
                result.after.append(errors(refined.cam_from_world, truth))
                result.accepted.append(refined.accepted)
                if refined.covariance is not None:
                    result.chi2.append(chi2_per_degree(refined, truth))
    head = ["query", "runs", "before", "after, p50", "p90", "within 5 mm, 0.1 deg", "accepted"]
    rows = [[*head, "chi2", "p50 s", "p95 s"]]
    rows += [result.row(kind) for kind, result in results.items()]
    print(table(rows))
    seconds = float(np.median(np.concatenate([each.seconds for each in results.values()])))
    if given.limit_s is not None and seconds > given.limit_s:
        sys.exit(f"the median query takes {seconds:.2f} s, more than {given.limit_s} s")


if __name__ == "__main__":
    main()
