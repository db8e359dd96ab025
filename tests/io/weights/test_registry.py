"""The registry is complete and consistent."""

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


def test_entries_are_keyed_by_their_names() -> None:
    assert len(registry()) > 20
    assert all(name == weights.name for name, weights in registry().items())


def test_no_file_is_listed_twice() -> None:
    names = [n for w in registry().values() for file in w.files for n in file.names]
    names += [weights.converted for weights in registry().values()]
    assert len(names) == len(set(names))
    sums = [file.sha256 for w in registry().values() for file in w.files if file.sha256]
    assert len(sums) == len(set(sums)) > 20


def test_addresses_licences_and_hashes_fit_the_files() -> None:
    checked = 0
    for weights in registry().values():
        assert weights.page.startswith("https://")
        forbids = re.search(r"noncommercial|research|-NC-|unconfirmed", weights.licence)
        assert weights.commercial == (forbids is None), weights.name
        for file in weights.files:
            # torch.hub calls a file by the first eight digits of its sha256
            if prefix := re.search(r"-([0-9a-f]{8})\.pth$", file.name):
                assert file.sha256 is not None and file.sha256.startswith(prefix[1])
                checked += 1
            if file.url is not None:
                assert file.url.startswith("https://")
                # the address has the folders of the name, perhaps with others between
                place = iter(file.url.partition("?")[0].split("/"))
                assert all(part in place for part in file.name.split("/")), file.url
                assert next(place, None) is None
    assert checked == 3


def test_lookup_suggests_a_similar_name() -> None:
    assert lookup("xfeat").files[0].name == "xfeat.pt"
    message = "no weights 'xfeet' in .*; did you mean 'xfeat'\\? there are"
    with pytest.raises(OptionError, match=message):
        lookup("xfeet")


def test_files_are_recognised_by_name_and_sha256() -> None:
    weights, _ = by_file_name("superpoint_lightglue_v0-1_arxiv.pth") or (None, None)
    assert weights is not None and weights.name == "superpoint_lightglue"
    _, file = by_file_name("alex.pth") or (None, None)
    assert file is not None and file.name == "v0.1/alex.pth"
    assert by_file_name("nothing.pth") is None and by_sha256(64 * "0") is None
