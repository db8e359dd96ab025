"""Lists of images with their cameras: values, variants, errors."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from megloc_twins.model_files import write_query_list

from megloc_kapture.datasets.aachen import read_query_list
from megloc_kapture.errors import DataError
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera

LINE = "query/day/nexus4/IMG_20140520_182846.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 -0.0353019"
OTHER = "query/day/milestone/b.jpg SIMPLE_RADIAL 768 1024 971.838 384 512 -0.00177789"
CAMERA = Camera("SIMPLE_RADIAL", 1600, 1200, (1469.2, 800.0, 600.0, -0.0353019))
OTHER_CAMERA = Camera("SIMPLE_RADIAL", 768, 1024, (971.838, 384.0, 512.0, -0.00177789))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "list.txt"


def test_images_in_their_order(path: Path) -> None:
    # the published lists end without a line end
    path.write_text(f"\n  \n{LINE.replace(' ', '  ')}\n\n{OTHER.replace(' ', chr(9))}")
    cameras = read_query_list(path)
    assert list(cameras.items()) == [(LINE.split()[0], CAMERA), (OTHER.split()[0], OTHER_CAMERA)]


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("a.jpg SIMPLE_RADIAL 1600", "'name MODEL WIDTH HEIGHT PARAMS...', got 3 fields"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600", "takes 4 parameters, got 3"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 0 0", "takes 4 parameters, got 5"),
        ("a.jpg FISH 1600 1200 1469.2 800 600 0", "unknown camera model 'FISH'"),
        ("a.jpg SIMPLE_RADIAL 1600.5 1200 1469.2 800 600 0", "'1600.5' is not a whole number"),
        ("a.jpg SIMPLE_RADIAL 0 1200 1469.2 800 600 0", "not positive"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 nan 800 600 0", "parameter 'nan' is not a finite number"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 -5 800 600 0", "focal length -5.0 is not positive"),
        ("../a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 0", "leads out of its folder"),
        (LINE, "is listed twice"),
        ("b c.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 0", "'SIMPLE_RADIAL' is not a whole"),
    ],
)
def test_bad_lines_name_file_and_line(path: Path, line: str, match: str) -> None:
    path.write_text(f"{LINE}\n\n{line}\n{OTHER}\n")
    with pytest.raises(DataError) as caught:
        read_query_list(path)
    assert str(caught.value).startswith(f"{path}:3: ") and match in str(caught.value)
    assert "\n" not in str(caught.value)


_NAMES = st.lists(
    st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z"), exclude_characters="/\\")),
    min_size=1,
    max_size=3,
).map("/".join)
_FINITE = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def _cameras(draw: st.DrawFn) -> Camera:
    model = draw(st.sampled_from(sorted(CAMERA_MODEL_NUM_PARAMS)))
    size = draw(st.tuples(*[st.integers(1, 999_999_999)] * 2))
    focals = draw(st.lists(st.floats(1e-300, 1e300), min_size=2, max_size=2))
    count = CAMERA_MODEL_NUM_PARAMS[model] - 2
    rest = draw(st.lists(_FINITE, min_size=count, max_size=count))
    one_focal = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    return Camera(model, *size, (*focals[:1], 0.0, *rest) if one_focal else (*focals, *rest))


@given(
    st.dictionaries(_NAMES.filter(lambda name: name.strip("./")), _cameras(), min_size=1),
    st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_reads_back_the_same(
    path: Path, cameras: dict[str, Camera], ended: bool
) -> None:
    try:
        write_query_list(path, cameras, last_line_ends=ended)
    except DataError:  # a name with ".." or an empty part in it
        return
    assert path.read_bytes().endswith(b"\n") == ended
    read = read_query_list(path)
    assert read == cameras
    assert list(read) == list(cameras)
