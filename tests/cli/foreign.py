"""A map and queries of another tool, with features whose names are not ours."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from megloc_kapture.io.kapture import FeatureWriter, KaptureFolder

KEYPOINTS = "reconstruction/keypoints/r2d2_800"
DESCRIPTORS = "reconstruction/descriptors/r2d2_800"
GLOBAL = "reconstruction/global_features/AP-GeM-LM18"
# the fixtures: rendered, and real
FOREIGN_MAPS = ["foreign_map", pytest.param("virtual_gallery", marks=pytest.mark.slow)]


def write_foreign(root: Path, finished: Path, scene: Path) -> None:
    """Write ``map/``, ``query/`` and ``query_gt/`` from a finished run of the scene.

    RootSIFT is stored under the name R2D2, VLAD under AP-GeM. Images are links.
    """
    shutil.copytree(scene / "query_gt", root / "query_gt")
    no_images = shutil.ignore_patterns("records_data")
    for part, of_scene in (("map", "mapping"), ("query", "query")):
        sensors = root / part / "sensors"
        shutil.copytree(finished / part / "sensors", sensors, ignore=no_images)
        images = scene / of_scene / "sensors" / "records_data"
        (sensors / "records_data").symlink_to(images.resolve())
        folder = KaptureFolder(finished / part, features_dirs=[finished])
        for kind in ("keypoints", "descriptors", "global_features"):
            _write_features(root / part, folder, kind)
    ours, theirs = (place / "map" / "reconstruction" for place in (finished, root))
    shutil.copyfile(ours / "points3d.txt", theirs / "points3d.txt")
    seen = (ours / "observations.txt").read_text()
    (theirs / "observations.txt").write_text(seen.replace("rootsift", "r2d2_800"))


def _write_features(root: Path, folder: KaptureFolder, kind: str) -> None:
    if kind == "global_features":
        reader = folder.global_features("vlad_rootsift")
        name, config = "AP-GeM-LM18", replace(reader.config, name="dirtorch")
    else:
        reader = getattr(folder, kind)("rootsift")
        owner = "r2d2_800" if kind == "descriptors" else None
        name, config = "r2d2_800", replace(reader.config, name="r2d2", keypoints_type=owner)
    writer = FeatureWriter(root, kind, name, config)
    for image in folder.read().image_names():
        writer.write(image, reader.read(image))


def rename_type(root: Path) -> None:
    """Rename the type of the keypoints to ``orb_800``, which has no extractor."""
    for part in ("map", "query"):
        for kind in (KEYPOINTS, DESCRIPTORS):
            folder = root / part / kind
            for table in folder.glob("*.txt"):
                table.write_text(table.read_text().replace("r2d2", "orb"))
            folder.rename(folder.with_name("orb_800"))
        seen = root / part / "reconstruction" / "observations.txt"
        if seen.is_file():
            seen.write_text(seen.read_text().replace("r2d2_800", "orb_800"))
