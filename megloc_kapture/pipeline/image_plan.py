"""The stages that make images and their local features: import, pre-processing, extraction."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.io.side_tables import SIDE_TABLES, Protocol
from megloc_kapture.pipeline.datasets import ProtocolChange
from megloc_kapture.pipeline.manifests import FileHashes
from megloc_kapture.pipeline.map_plan import check_given
from megloc_kapture.pipeline.plan import Stage
from megloc_kapture.pipeline.run import MAPPING, PREPROCESSED, QUERY, QUERY_GT, REFERENCE, Run
from megloc_kapture.pipeline.workspace import HASHES
from megloc_kapture.plugins import SEGMENTERS, LocalFeatureExtractor, load_plugin, weights_of
from megloc_kapture.stages.given_map import has_descriptors
from megloc_kapture.stages.image_masks import MaskOptions
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.preprocessing import preprocess_images


def plan_images(run: Run, dump: Mapping[str, Any]) -> list[Stage]:
    """From a dataset to local features; the last stage is called ``local_features``.

    Parameters
    ----------
    dump : the options as plain JSON values.
    """
    remembered = run.workspace.path(HASHES)
    hashes = FileHashes(remembered)
    stages = [*_dataset_stages(run, hashes), *_preprocessing_stages(run, dump, hashes)]
    if hashes.content():
        write_bytes(remembered, (json.dumps(hashes.content()) + "\n").encode())
    return [
        *stages,
        Stage(
            "local_features",
            1,
            _features_used(run, dump),
            ("import", run.images_stage),
            ("local_features",),
            lambda out: _local_features(run, out),
        ),
    ]


def _dataset_stages(run: Run, hashes: FileHashes) -> list[Stage]:
    """Import, behind rendering where the dataset is made rather than given."""

    def change(given: Protocol) -> Protocol:
        if given.dataset == Protocol().dataset:
            given = given.model_copy(update={"dataset": run.dataset})
        return given if run.benchmark is None else run.benchmark.change(given)

    source = run.source
    outputs = (MAPPING, QUERY, QUERY_GT, SIDE_TABLES, REFERENCE)
    wanted = None if run.benchmark is None else run.benchmark.change(Protocol())
    settings = {**source.settings(), "protocol": wanted and wanted.model_dump(mode="json")}
    render = source.renderer(run.work)
    if render is not None:
        world = run.workspace.path("world")
        return [
            Stage("render", 1, source.render_options(), (), ("world",), render),
            Stage(
                "import",
                3,
                settings,
                ("render",),
                outputs,
                lambda out: _import(run, world, out, change),
            ),
        ]
    if source.root is None:
        raise ValueError("a run needs a root or something that renders one")
    source.check()
    root = source.root.resolve()
    content = hashes.of_files(root, source.input_files(root))
    external = {"dataset files": content, "dataset root": str(root)}
    return [
        Stage(
            "import",
            3,
            settings,
            (),
            outputs,
            lambda out: _import(run, root, out, change),
            external,
        )
    ]


def _import(run: Run, root: Path, out: Path, change: ProtocolChange) -> dict[str, float]:
    counts = run.source.import_to(root, out, change)
    if not counts["queries"]:
        raise DataError("no query image is left to localize", path=root)
    return counts


def _preprocessing_stages(run: Run, dump: Mapping[str, Any], hashes: FileHashes) -> list[Stage]:
    options = run.options.preprocessing
    if not run.options.preprocesses():
        return []
    chosen = options.masks.segmenter
    weights = {}
    if chosen is not None:
        weights = weights_of(load_plugin(SEGMENTERS, chosen.name, chosen.options))
    return [
        Stage(
            "preprocess",
            1,
            {"preprocessing": dump["preprocessing"], "weights": weights},
            ("import",),
            (PREPROCESSED,),
            lambda out: _preprocess(run, out),
            _given_masks(options.masks, hashes),
        )
    ]


def _given_masks(options: MaskOptions, hashes: FileHashes) -> dict[str, str]:
    """Fingerprints of the masks that lie outside the workspace."""
    drawn = [fixed.file for fixed in options.fixed if fixed.file is not None]
    found = {f"mask {path}": hashes.of_file(path.resolve()) for path in drawn}
    if options.user_masks is not None:
        root = options.user_masks.resolve()
        found["user masks"] = hashes.of_files(root, root.rglob("*.png"))
    return found


def _preprocess(run: Run, out: Path) -> dict[str, float]:
    mapping, query = run.workspace.folder(MAPPING), run.workspace.folder(QUERY)
    counts: dict[str, float] = {}
    # the queries of one camera may be few, or all at night
    for folder, others in ((mapping, []), (query, [mapping])):
        found = preprocess_images(
            folder,
            out / PREPROCESSED / folder.root.name,
            run.options.preprocessing,
            sequences=others,
            work=run.work,
        )
        counts |= {f"{folder.root.name}_{name}": count for name, count in found.items()}
    return counts


def _features_used(run: Run, dump: Mapping[str, Any]) -> dict[str, Any]:
    """Options and weights of the features that are extracted at all."""
    used: dict[str, Any] = {"mask_margin_px": dump["mask_margin_px"]}
    if run.options.makes_points():
        used["local_features"] = [
            {"name": chosen["name"], "options": chosen["options"], "weights": weights_of(extractor)}
            for chosen, extractor in zip(
                dump["local_features"], run.options.make_extractors(), strict=True
            )
        ]
    if run.options.uses_given_map():
        weights = weights_of(run.options.make_given_extractor())
        used["given_features"] = {**dump["given_features"], "weights": weights}
    return used


def _local_features(run: Run, out: Path) -> dict[str, int]:
    mapping, query = run.workspace.folder(run.mapping), run.workspace.folder(run.query)
    work: list[tuple[LocalFeatureExtractor, list[KaptureFolder]]] = [
        (extractor, [mapping, query]) for extractor in run.options.own_extractors()
    ]
    if run.options.uses_given_map():
        check_given(run)
        described = has_descriptors(run.workspace.folder(REFERENCE))
        folders = [query] if described else [mapping, query]
        work.append((run.options.make_given_extractor(), folders))
    counts: Counter[str] = Counter()
    for extractor, folders in work:
        found = extract_local_features(
            folders,
            extractor,
            out,
            mask_margin_px=run.options.mask_margin_px,
            work=run.work,
        )
        counts.update(found)
    return counts
