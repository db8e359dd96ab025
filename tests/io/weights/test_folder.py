"""The folder of weights: lookup, checks against the registry, adding and converting files."""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
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
    lookup,
    read_weights,
    registry,
    sha256_of,
    weights_folder,
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    place = tmp_path / "weights"
    place.mkdir()
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(place))
    return place


@pytest.fixture
def published(shared_data: Path) -> Path:
    """The published files on this machine; read only."""
    place = shared_data / "weights"
    if not place.is_dir():
        pytest.skip(f"no {place}")
    return place


def write(path: Path, value: float = 1.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"a": torch.tensor([value])}, path)
    return path


@pytest.mark.parametrize("name", ["aliked-t16", "xfeat", "r2d2_WAF_N16"])
def test_published_files_have_the_size_and_sha256_of_the_registry(
    published: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(published))
    file = find_weights(name)
    assert file.published is not None and file.published.sha256 == sha256_of(file)
    assert file.published.size == file.size == file.path.stat().st_size
    # R2D2's names have a prefix of torch's DataParallel
    assert not any(key.startswith("module.") for key in read_weights(file))


def test_the_environment_sets_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", "../relative")
    monkeypatch.chdir(tmp_path)
    assert weights_folder() == tmp_path.parent / "relative"
    monkeypatch.delenv("MEGLOC_WEIGHTS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert weights_folder() == tmp_path / "cache" / "megloc-kapture" / "weights"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert weights_folder() == tmp_path / ".cache" / "megloc-kapture" / "weights"


def test_weights_lie_in_the_folder_or_one_below_under_any_of_their_names(folder: Path) -> None:
    name = "superpoint_v6_from_tf"
    write(folder / "a" / "b" / f"{name}.pth")
    with pytest.raises(MissingWeightsError):
        find_weights(name)
    for place in (folder / "a", folder):
        inside = write(place / f"{name}.pth")
        assert find_weights(name).path == inside
    save_file({"a": torch.ones(1)}, folder / "aslfeat.safetensors")
    write(folder / "aslfeat.tar")  # the published file, which must be converted
    assert read_weights(find_weights("aslfeat")).keys() == {"a"}
    other = write(folder / "best_deeplabv3plus_resnet101_cityscapes_os16.pth.tar")
    assert find_weights("deeplabv3plus-resnet101").path == other


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("xfeat", "accelerated_features; run: megloc weights fetch xfeat"),
        ("superglue_outdoor", "run: megloc weights fetch superglue_outdoor --accept-licence"),
        ("aslfeat", "and run: python scripts/convert_weights.py aslfeat FILE"),
        ("my.pth", "is neither a file nor a name in the registry (megloc weights list)"),
    ],
)
def test_missing_weights_name_the_remedy(folder: Path, name: str, remedy: str) -> None:
    with pytest.raises(MissingWeightsError) as caught:
        find_weights(name)
    assert name in str(caught.value) and str(caught.value).endswith(remedy)
    assert isinstance(pickle.loads(pickle.dumps(caught.value)), MissingWeightsError)


def test_a_file_given_by_path_may_be_any(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fine-tuned network may have the name of a published file."""
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
    message = f"{path}: is not the published superpoint_v1.pth of superpoint_v1: sha256 "
    message += f"{sha256_of(file)} instead of {known}; "
    with pytest.raises(DataError, match=re.escape(message)):
        read_weights(file)


def test_safetensors_are_recognised_by_content(tmp_path: Path) -> None:
    save_file({"module.a": torch.ones(1)}, tmp_path / "net.pth")
    assert list(read_weights(find_weights(str(tmp_path / "net.pth")))) == ["a"]


def test_a_folder_of_weights_that_cannot_be_written_names_the_setting(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="x.pt: cannot write: .*; MEGLOC_WEIGHTS sets another"):
        fetch("http://localhost/x.pt", tmp_path / "file" / "x.pt")


def test_a_broken_download_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with pytest.raises(MeglocError, match="the transfer failed.*run: megloc weights add FILE"):
        fetch("http://127.0.0.1:9/net.pth", tmp_path / "net.pth")
    assert list(tmp_path.iterdir()) == []


def test_code_in_a_checkpoint_is_not_run(code: object, tmp_path: Path) -> None:
    torch.save({"a": torch.ones(1), "optimizer": code}, tmp_path / "x.pth")
    with pytest.raises(DataError, match=r"x\.pth: not weights that torch .* without running code"):
        read_weights(find_weights(str(tmp_path / "x.pth")))
    assert not (tmp_path / "made").exists()


def test_added_files_are_recognised_by_hash(published: Path, folder: Path, tmp_path: Path) -> None:
    source = tmp_path / "download (1).bin"
    shutil.copyfile(published / "aliked" / "aliked-t16.pth", source)
    added = add_weights(source)
    assert (added.name, added.path) == ("aliked-t16", folder / "aliked-t16.pth")
    assert added.path.read_bytes() == source.read_bytes()
    assert add_weights(source) == added  # a second time is no error
    assert [path.name for path in folder.iterdir()] == ["aliked-t16.pth"]


def test_unknown_files_are_added_under_a_given_name(folder: Path, tmp_path: Path) -> None:
    source = write(tmp_path / "model_best.pth")
    with pytest.raises(OptionError, match=r"neither its sha256 nor its name is in the reg"):
        add_weights(source)
    assert add_weights(source, name="openibl").path == folder / "vgg16_netvlad.pth"
    with pytest.raises(OptionError, match="no weights 'openibble' in the registry"):
        add_weights(source, name="openibble")
    other = source.rename(source.with_suffix(".bin"))
    with pytest.raises(OptionError, match=r"that of vgg16_netvlad\.pth or openibl\.safetensors"):
        add_weights(other, name="openibl")
    converted = tmp_path / "x.safetensors"
    save_file({"a": torch.ones(1)}, converted)
    assert add_weights(converted, name="aslfeat").path == folder / "aslfeat.safetensors"


def test_broken_missing_and_different_files_are_not_added(folder: Path, tmp_path: Path) -> None:
    different = write(tmp_path / "superpoint_v1.pth", 3.0)
    broken = tmp_path / "vgg16_netvlad.pth"
    broken.write_bytes(b"<html>sign in</html>")
    for source, unverified, message in (
        (different, False, r"published superpoint_v1\.pth .* instead of 52b67"),
        (broken, False, "not weights that torch"),
        (broken, True, "not weights that torch"),
        (tmp_path / "nowhere.pth", False, "the file is missing"),
    ):
        with pytest.raises(DataError, match=message):
            add_weights(source, unverified=unverified)
    assert list(folder.iterdir()) == []


def test_an_unverified_file_replaces_a_missing_published_one(folder: Path, tmp_path: Path) -> None:
    source = write(tmp_path / "superpoint_v1.pth", 3.0)
    added = add_weights(source, unverified=True)
    assert added.path == folder / "unverified" / "superpoint_v1.pth"
    file = find_weights("superpoint_v1")
    assert file.path == added.path and file.published is None
    assert read_weights(file)["a"] == 3
    shutil.copyfile(source, folder / "superpoint_v1.pth")
    with pytest.raises(DataError, match="is not the published superpoint_v1.pth"):
        read_weights(find_weights("superpoint_v1"))


def test_an_existing_file_is_replaced_only_by_force(folder: Path, tmp_path: Path) -> None:
    place = write(folder / "vgg16_netvlad.pth", 1.0)
    before = place.read_bytes()
    source = write(tmp_path / "vgg16_netvlad.pth", 2.0)
    with pytest.raises(OutputError, match="a different file exists; -f replaces it"):
        add_weights(source)
    assert place.read_bytes() == before
    add_weights(source, force=True)
    assert place.read_bytes() == source.read_bytes()


def test_converted_files_keep_all_tensors_and_the_source(published: Path, tmp_path: Path) -> None:
    source, output = published / "r2d2" / "r2d2_WAF_N16.pt", tmp_path / "x.safetensors"
    count = convert_weights(source, output)
    expected, actual = read_weights(describe("r2d2", source)), read_weights(describe("x", output))
    assert actual.keys() == expected.keys() and count == len(actual) == 46
    assert all(torch.equal(actual[key], expected[key]) for key in expected)
    with safe_open(output, "pt") as opened:
        assert opened.metadata() == {SOURCE_KEY: sha256_of(describe("r2d2", source))}


def test_tensors_that_share_memory_are_converted_each(tmp_path: Path) -> None:
    source, output = tmp_path / "x.pth", tmp_path / "x.safetensors"
    whole = torch.arange(6.0)
    torch.save({"a": whole, "b": whole[2:4], "c": whole.reshape(2, 3).T}, source)
    convert_weights(source, output)
    actual = read_weights(describe("x", output))
    assert actual["b"].tolist() == [2, 3] and actual["c"].tolist() == [[0, 3], [1, 4], [2, 5]]


def test_conversions_of_wrong_paths_are_refused(tmp_path: Path) -> None:
    source, output = write(tmp_path / "x.pth"), tmp_path / "x.safetensors"
    output.touch()
    refusals: list[tuple[Path, Path, type[MeglocError], str]] = [
        (source, tmp_path / "x.npz", OptionError, "must end in .safetensors"),
        (tmp_path / "y.pth", tmp_path / "y.safetensors", DataError, "the file is missing"),
        (source, output, OutputError, "exists; -f replaces it"),
    ]
    for wrong, target, kind, message in refusals:
        with pytest.raises(kind, match=message):
            convert_weights(wrong, target)
    assert convert_weights(source, output, force=True) == 1


@pytest.mark.parametrize("key", ["model_state_dict", "state_dict", "net"])
@pytest.mark.parametrize("prefix", ["", "module.", "model.", "_orig_mod.module."])
def test_checkpoints_of_training_scripts_are_read(tmp_path: Path, key: str, prefix: str) -> None:
    content = {"epoch": 3, key: {f"{prefix}conv.weight": torch.ones(1)}, "loss": torch.ones(1)}
    torch.save(content, tmp_path / "x.pth")
    assert read_weights(find_weights(str(tmp_path / "x.pth"))).keys() == {"conv.weight"}


def test_a_checkpoint_may_hold_a_score_of_numpy(tmp_path: Path) -> None:
    for score in (np.float64(0.7), np.float32(0.7)):
        torch.save({"model_state": {"a": torch.ones(1)}, "best_score": score}, tmp_path / "x.pth")
        assert read_weights(find_weights(str(tmp_path / "x.pth"))).keys() == {"a"}


# ------------------------------------------------------------------ the registry


def test_no_file_is_listed_twice() -> None:
    names = [n for w in registry().values() for file in w.files for n in file.names]
    names += [weights.converted for weights in registry().values()]
    assert len(names) == len(set(names))
    sums = [file.sha256 for w in registry().values() for file in w.files if file.sha256]
    assert len(sums) == len(set(sums)) > 20
    assert all(re.fullmatch("[0-9a-f]{64}", sha256) for sha256 in sums)
    assert all(name == weights.name for name, weights in registry().items())


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
