"""The arrays of a sparse model."""

from __future__ import annotations

import numpy as np
import pytest

from megloc_kapture.datasets.formats.sparse_points import SparsePoints, image_order


def points(num_points: int, rows: list[tuple[int, int, int]]) -> SparsePoints:
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    return SparsePoints(
        np.arange(3.0 * num_points).reshape(-1, 3),
        np.full((num_points, 3), num_points, np.uint8),
        table[:, 0],
        table[:, 1].astype(np.int32),
        table[:, 2].astype(np.int32),
        table[:, 1:].astype(np.float32),
    )


@pytest.mark.parametrize("highest", [1, 5, 2**16 - 1, 2**16, 2**31 - 1])
def test_rows_are_grouped_by_image_in_their_order(highest: int) -> None:
    ids = np.random.default_rng(0).integers(0, highest, 5000, endpoint=True).astype(np.int32)
    ids[:2] = highest
    assert np.array_equal(image_order(ids), np.argsort(ids, kind="stable"))
    assert image_order(ids[:0]).tolist() == []


def test_models_are_joined_behind_one_another() -> None:
    first, second = points(2, [(0, 0, 5), (1, 1, 6)]), points(3, [(0, 1, 7), (2, 0, 8)])
    joined = SparsePoints.joined([first, SparsePoints.none(), second])
    assert len(joined) == 5
    assert joined.rgb[:, 0].tolist() == [2, 2, 3, 3, 3]
    assert joined.point_ids.tolist() == [0, 1, 2, 4]
    assert joined.image_ids.tolist() == [0, 1, 1, 0]
    assert joined.feature_ids.tolist() == [5, 6, 7, 8]
    assert joined.xy_px.dtype == np.float32
    assert joined.image_ids.dtype == np.int32
    assert len(SparsePoints.joined([])) == 0


def test_sorting_by_point_keeps_the_order_of_equals() -> None:
    ordered = points(3, [(2, 0, 1), (0, 1, 2), (2, 1, 3), (0, 0, 4)]).sorted_by_point()
    assert ordered.point_ids.tolist() == [0, 0, 2, 2]
    assert ordered.xy_px.tolist() == [[1, 2], [0, 4], [0, 1], [1, 3]]
    for ids, column in ((ordered.image_ids, 0), (ordered.feature_ids, 1)):
        assert ids.tolist() == ordered.xy_px[:, column].tolist()
    assert ordered.sorted_by_point() is ordered
    for bad in (3, -1):
        with pytest.raises(ValueError, match="point_ids are out of range"):
            points(3, [(bad, 0, 0)]).sorted_by_point()


def test_image_ids_are_checked() -> None:
    model = points(1, [(0, 0, 0), (0, 4, 0)])
    model.check_images(5)
    SparsePoints.none().check_images(0)
    with pytest.raises(ValueError, match="there are 4 images"):
        model.check_images(4)
    with pytest.raises(ValueError, match="out of range"):
        points(1, [(0, -1, 0)]).check_images(4)


@pytest.mark.parametrize("name", ["rgb", "image_ids", "feature_ids", "xy_px"])
def test_arrays_must_fit_together(name: str) -> None:
    good = points(2, [(0, 0, 5)])
    arrays = {key: getattr(good, key) for key in vars(good)}
    arrays[name] = arrays[name][:0]
    with pytest.raises(ValueError, match=f"{name} has shape"):
        SparsePoints(**arrays)
