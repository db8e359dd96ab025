"""Where weights are looked for, and that what is read is what the registry knows."""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hostile import Runs
from safetensors.torch import save_file

from megloc_kapture.errors import DataError, MeglocError, OptionError, OutputError
from megloc_kapture.io.weights import (
    SOURCE_KEY,
    MissingWeightsError,
    add_weights,
    convert_weights,
    describe,
    fetch,
    find_weights,
    read_weights,
    registry,
    sha256_of,
    weights_folder,
)

COUNTS = {
    "aliked-t16": 192_588,
    "aliked-n16": 678_324,
    "aliked-n16rot": 678_324,
    "aliked-n32": 980_468,
    "xfeat": 1_551_625,
    "r2d2_WAF_N16": 485_803,
    "r2d2_WASF_N16": 485_803,
    "r2d2_WASF_N8_big": 1_041_019,
    "espnetv2-cityscapes": 247_279,
    "lpips-alex": 1_152,
    "lpips-vgg": 1_472,
    "lpips-squeeze": 2_240,
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of weights."""
    place = tmp_path / "weights"
    place.mkdir()
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(place))
    return place


@pytest.fixture
def published(shared_data: Path) -> Path:
    """The published files there are; not to be written into."""
    place = shared_data / "weights"
    if not place.is_dir():
        pytest.skip(f"no {place}")
    return place


def write(path: Path, value: float = 1.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"a": torch.tensor([value])}, path)
    return path


@pytest.mark.parametrize("name", COUNTS)
def test_published_files(published: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Counts of values as nets.md has them; R2D2's come out of ``state_dict`` and ``module.``."""
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(published))
    file = find_weights(name)
    tensors = read_weights(file)
    assert sum(tensor.numel() for tensor in tensors.values()) == COUNTS[name]
    assert not any(key.startswith("module.") for key in tensors)
    assert file.published is not None and file.published.sha256 == sha256_of(file)
    assert file.published.size == file.size == file.path.stat().st_size


def test_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", "../relative")
    monkeypatch.chdir(tmp_path)
    assert weights_folder() == tmp_path.parent / "relative"
    monkeypatch.delenv("MEGLOC_WEIGHTS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert weights_folder() == tmp_path / "cache" / "megloc-kapture" / "weights"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert weights_folder() == tmp_path / ".cache" / "megloc-kapture" / "weights"


def test_in_the_folder_or_one_below_under_any_of_its_names(folder: Path) -> None:
    name = "superpoint_v6_from_tf"
    write(folder / "a" / "b" / f"{name}.pth")
    with pytest.raises(MissingWeightsError):
        find_weights(name)
    for place in (folder / "a", folder):
        inside = write(place / f"{name}.pth")
        assert find_weights(name).path == inside
    save_file({"a": torch.ones(1)}, folder / "aslfeat.safetensors")
    write(folder / "aslfeat.tar")  # must be converted, and was
    assert read_weights(find_weights("aslfeat")).keys() == {"a"}
    other = write(folder / "best_deeplabv3plus_resnet101_cityscapes_os16.pth.tar")
    assert find_weights("deeplabv3plus-resnet101").path == other


def test_what_is_missing_is_told(folder: Path) -> None:
    told = {
        "xfeat": (
            f"no xfeat.pt in {folder}; published at https://github.com/verlab/"
            "accelerated_features; run: megloc weights fetch xfeat"
        ),
        "superglue_outdoor": (
            "(for noncommercial research at academic or non-profit organizations; not to be passed "
            "on); run: megloc weights fetch superglue_outdoor --accept-licence"
        ),
        "aslfeat": (
            "download it from https://github.com/lzx551402/ASLFeat and run: python "
            "scripts/convert_weights.py aslfeat FILE"
        ),
    }
    for name, text in told.items():
        with pytest.raises(MissingWeightsError) as error:
            find_weights(name)
        assert str(error.value).endswith(text)
        assert isinstance(pickle.loads(pickle.dumps(error.value)), MissingWeightsError)
    with pytest.raises(MissingWeightsError, match="'my.pth' is neither a file nor a name in the"):
        find_weights("my.pth")


def test_a_file_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trained further, it may have a published file's name: by its path it is taken as it is."""
    path = write(tmp_path / "superpoint_v1.pth")
    file = find_weights(str(path))
    assert (file.name, file.path, file.published) == ("superpoint_v1.pth", path, None)
    assert read_weights(file)["a"] == 1
    monkeypatch.chdir(tmp_path)
    assert find_weights("superpoint_v1.pth") == file == pickle.loads(pickle.dumps(file))
    write(path, 2.0)
    os.utime(path, ns=(1, 1))
    changed = find_weights(str(path))
    assert changed != file and sha256_of(changed) == hashlib.sha256(path.read_bytes()).hexdigest()


def test_another_file_under_a_published_name_is_refused(folder: Path) -> None:
    path = write(folder / "superpoint_v1.pth")
    file, known = find_weights("superpoint_v1"), registry()["superpoint_v1"].files[0].sha256
    told = f"{path}: is not the published superpoint_v1.pth of superpoint_v1: sha256 "
    told += f"{sha256_of(file)} instead"
    with pytest.raises(DataError, match=re.escape(f"{told} of {known}; ")):
        read_weights(file)


def test_a_broken_download_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with pytest.raises(MeglocError, match="the transfer broke"):
        fetch("http://127.0.0.1:9/net.pth", tmp_path / "net.pth")
    assert list(tmp_path.iterdir()) == []


def test_code_is_not_run(tmp_path: Path) -> None:
    torch.save({"a": torch.ones(1), "optimizer": Runs(tmp_path / "made")}, tmp_path / "x.pth")
    with pytest.raises(DataError, match=r"x\.pth: not weights of torch .* that hold no code"):
        read_weights(find_weights(str(tmp_path / "x.pth")))
    assert not (tmp_path / "made").exists()


def test_looking_for_weights_does_not_import_torch() -> None:
    code = (
        "import sys, megloc_kapture.io.weights as w\n"
        "try: w.find_weights('aslfeat')\n"
        "except w.MissingWeightsError: pass\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_add_recognises_by_sha256(published: Path, folder: Path, tmp_path: Path) -> None:
    source = tmp_path / "download (1).bin"
    shutil.copyfile(published / "aliked" / "aliked-t16.pth", source)
    added = add_weights(source)
    assert (added.name, added.path) == ("aliked-t16", folder / "aliked-t16.pth")
    assert added.path.read_bytes() == source.read_bytes()
    assert add_weights(source) == added  # once more is no fault
    assert [path.name for path in folder.iterdir()] == ["aliked-t16.pth"]


def test_add_recognises_by_name_or_is_told(folder: Path, tmp_path: Path) -> None:
    source = write(tmp_path / "best_deeplabv3plus_resnet101_cityscapes_os16.pth.tar")
    added = add_weights(source)
    assert added.path == folder / "best_deeplabv3plus_resnet101_cityscapes_os16.pth"
    assert find_weights("deeplabv3plus-resnet101") == added and source.is_file()
    source = write(tmp_path / "model_best.pth")
    with pytest.raises(OptionError, match=r"neither its sha256 nor its name is in the reg"):
        add_weights(source)
    assert add_weights(source, name="openibl").path == folder / "vgg16_netvlad.pth"
    with pytest.raises(OptionError, match="no weights 'openibble' in the registry"):
        add_weights(source, name="openibble")
    odd = source.rename(source.with_suffix(".bin"))
    with pytest.raises(OptionError, match=r"kept as vgg16_netvlad\.pth or openibl\.safetensors"):
        add_weights(odd, name="openibl")
    other = tmp_path / "x.safetensors"
    save_file({"a": torch.ones(1)}, other)
    assert add_weights(other, name="aslfeat").path == folder / "aslfeat.safetensors"


def test_add_refuses_what_is_broken_and_on_request_takes_another_file(
    folder: Path, tmp_path: Path
) -> None:
    own = write(tmp_path / "superpoint_v1.pth", 3.0)
    broken = tmp_path / "vgg16_netvlad.pth"
    broken.write_bytes(b"<html>sign in</html>")
    for source, unverified, told in (
        (own, False, r"published superpoint_v1\.pth .* instead of 52b67"),
        (broken, False, "not weights of torch"),
        (broken, True, "not weights of torch"),
        (tmp_path / "nowhere.pth", False, "no such file"),
    ):
        with pytest.raises(DataError, match=told):
            add_weights(source, unverified=unverified)
    assert list(folder.iterdir()) == []
    added = add_weights(own, unverified=True)
    assert added.path == folder / "unverified" / "superpoint_v1.pth"
    found = find_weights("superpoint_v1")
    assert found.path == added.path and found.published is None
    assert read_weights(found).keys() == read_weights(describe("own", own)).keys()
    # the published one comes first, and is checked
    shutil.copyfile(own, folder / "superpoint_v1.pth")
    with pytest.raises(DataError, match="is not the published superpoint_v1.pth"):
        read_weights(find_weights("superpoint_v1"))


def test_add_does_not_replace_without_being_asked(folder: Path, tmp_path: Path) -> None:
    place = write(folder / "vgg16_netvlad.pth", 1.0)
    before = place.read_bytes()
    source = write(tmp_path / "vgg16_netvlad.pth", 2.0)
    with pytest.raises(OutputError, match="a different file exists; -f replaces it"):
        add_weights(source)
    assert place.read_bytes() == before
    add_weights(source, force=True)
    assert place.read_bytes() == source.read_bytes()


def test_convert_keeps_everything_and_is_deterministic(published: Path, tmp_path: Path) -> None:
    source = published / "r2d2" / "r2d2_WAF_N16.pt"
    before = source.read_bytes()
    places = [tmp_path / f"{row}.safetensors" for row in range(2)]
    code = "import sys; from pathlib import Path; import megloc_kapture.io.weights as c;"
    code += "c.convert_weights(Path(sys.argv[1]), Path(sys.argv[2]))"
    count = convert_weights(source, places[0])
    subprocess.run([sys.executable, "-c", code, source, places[1]], check=True)
    assert places[0].read_bytes() == places[1].read_bytes()
    expected = read_weights(describe("r2d2", source))
    found = read_weights(find_weights(str(places[0])))
    assert found.keys() == expected.keys() and count == len(found) == 46
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    assert source.read_bytes() == before
    from safetensors import safe_open

    with safe_open(places[0], "pt") as opened:
        assert opened.metadata() == {SOURCE_KEY: sha256_of(describe("r2d2", source))}


def test_convert_views_of_one_memory_and_refuses(tmp_path: Path) -> None:
    source, place = tmp_path / "x.pth", tmp_path / "x.safetensors"
    whole = torch.arange(6.0)
    torch.save({"a": whole, "b": whole[2:4], "c": whole.reshape(2, 3).T}, source)
    convert_weights(source, place)
    found = read_weights(find_weights(str(place)))
    assert found["b"].tolist() == [2, 3] and found["c"].tolist() == [[0, 3], [1, 4], [2, 5]]
    refusals: list[tuple[Path, Path, type[MeglocError], str]] = [
        (source, tmp_path / "x.npz", OptionError, "must end in .safetensors"),
        (tmp_path / "y.pth", tmp_path / "y.safetensors", DataError, "no such file"),
        (source, place, OutputError, "exists; -f replaces it"),
    ]
    for wrong, target, kind, message in refusals:
        with pytest.raises(kind, match=message):
            convert_weights(wrong, target)
    convert_weights(source, place, force=True)


def test_a_score_of_numpy_beside_the_weights(tmp_path: Path) -> None:
    for score in (np.float64(0.7), np.float32(0.7)):
        torch.save({"model_state": {"a": torch.ones(1)}, "best_score": score}, tmp_path / "x.pth")
        assert read_weights(find_weights(str(tmp_path / "x.pth"))).keys() == {"a"}
