"""Global features that cannot be computed."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import OptionError
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.pipeline.presets import options_of_preset
from tests.pipeline.runs import evaluated

pytestmark = pytest.mark.slow


def test_all_missing_weights_are_told_at_once(fountain: Path, tmp_path: Path) -> None:
    root = tmp_path / "workspace"
    with pytest.raises(MissingWeightsError) as caught:
        evaluated(root, fountain, options_of_preset("megloc"))
    *said, together = str(caught.value).splitlines()
    assert len(said) == len(set(said)) == 7
    assert "megloc weights fetch --preset megloc" in together
    for name in ("superpoint_v1", "superglue", "aslfeat", "netvlad", "delg", "apgem", "openibl"):
        assert any(name in line for line in said), name
    assert not root.exists()


def test_vectors_that_cannot_be_are_refused(fountain: Path, tmp_path: Path) -> None:
    twice = options_of_preset(assignments=['global_features=["vlad","vlad"]'])
    with pytest.raises(OptionError, match="global features 'vlad_rootsift' are listed twice"):
        evaluated(tmp_path / "workspace", fountain, twice)
    wrong = options_of_preset(assignments=["global_features.options.num_clusters=0"])
    with pytest.raises(OptionError, match="'vlad' refuse their options: num_clusters"):
        wrong.retrieval()
