"""The registry is whole and agrees with itself."""

from __future__ import annotations

import re

import pytest

from megloc_kapture.errors import OptionError
from megloc_kapture.io.weights import (
    by_file_name,
    by_sha256,
    lookup,
    registry,
)

# what plugins call their weights by
NAMES = (
    *("superpoint_v1", "superpoint_v6_from_tf", "superglue_outdoor", "superglue_indoor"),
    *("aslfeat", "aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"),
    *("xfeat", "xfeat-lighterglue", "r2d2_WAF_N16", "r2d2_WASF_N16", "r2d2_WASF_N8_big"),
    *("superpoint_lightglue", "aliked_lightglue"),
    *("deeplabv3plus-resnet101", "deeplabv3plus-mobilenet"),
    *("apgem-resnet101", "apgem-resnet101-lm18", "delg-r50-gld", "delg-r101-gldv2clean"),
)


def test_all_plugins_find_theirs() -> None:
    assert set(NAMES) <= set(registry())
    assert all(name == weights.name for name, weights in registry().items())


def test_no_file_is_two() -> None:
    names = [n for w in registry().values() for file in w.files for n in file.names]
    names += [weights.converted for weights in registry().values()]
    assert len(names) == len(set(names))
    sums = [file.sha256 for w in registry().values() for file in w.files if file.sha256]
    assert len(sums) == len(set(sums)) > 20


def test_places_licences_and_hashes_fit_the_files() -> None:
    checked = 0
    for weights in registry().values():
        assert weights.page.startswith("https://")
        forbids = re.search(r"noncommercial|research|-NC-|unconfirmed", weights.licence)
        assert weights.commercial == (forbids is None), weights.name
        for file in weights.files:
            # torch.hub calls a file by the first eight digits of its sha256
            if found := re.search(r"-([0-9a-f]{8})\.pth$", file.name):
                assert file.sha256 is not None and file.sha256.startswith(found[1])
                checked += 1
            if file.url is not None:
                assert file.url.startswith("https://")
                # folders of the name may stand anywhere above
                place = iter(file.url.partition("?")[0].split("/"))
                assert all(part in place for part in file.name.split("/")), file.url
                assert next(place, None) is None
    assert checked == 3


def test_lookup() -> None:
    assert lookup("xfeat").files[0].name == "xfeat.pt"
    with pytest.raises(
        OptionError, match="no weights 'xfeet' in .*; did you mean 'xfeat'\\? there are"
    ):
        lookup("xfeet")
    found = by_file_name("superpoint_lightglue_v0-1_arxiv.pth")
    assert found is not None and found[0].name == "superpoint_lightglue"
    found = by_file_name("alex.pth")
    assert found is not None and found[1].name == "v0.1/alex.pth"
    assert by_file_name("nothing.pth") is None and by_sha256(64 * "0") is None
