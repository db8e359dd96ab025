"""Where weights are looked for, and that what is read is what the registry knows."""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from megloc_kapture.errors import DataError, MeglocError, OptionError, OutputError
from megloc_kapture.features.global_networks import OpenIbl, OpenIblOptions
from megloc_kapture.io import weights as weights_module
from megloc_kapture.io.weights import (
    SOURCE_KEY,
    MissingWeightsError,
    add_weights,
    convert_weights,
    describe,
    find_weights,
    read_weights,
    sha256_of,
    share_weights,
    weights_folder,
)
from megloc_kapture.io.weights.registry import registry
from megloc_kapture.nets.global_descriptors import VggNetVlad
from megloc_kapture.pipeline.executors import open_executor

BUNDLE = Path(__file__).parent / "data" / "tensor_bundle"
COUNTS = {
    "aliked-t16": 192_588,
    "aliked-n16": 678_324,
    "aliked-n16rot": 678_324,
    "aliked-n32": 980_468,
    "xfeat": 1_551_625,  # with the fine matcher, which the ONNX file lacks
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


def test_in_the_folder_or_one_below(folder: Path) -> None:
    deep = write(folder / "a" / "b" / "superpoint_v6_from_tf.pth")
    with pytest.raises(MissingWeightsError):
        find_weights("superpoint_v6_from_tf")
    below = write(folder / "a" / "superpoint_v6_from_tf.pth")
    assert find_weights("superpoint_v6_from_tf").path == below != deep
    inside = write(folder / "superpoint_v6_from_tf.pth")
    assert find_weights("superpoint_v6_from_tf").path == inside


def test_other_names_and_converted_files(folder: Path) -> None:
    save_file({"a": torch.ones(1)}, folder / "aslfeat.safetensors")
    assert read_weights(find_weights("aslfeat")).keys() == {"a"}
    write(folder / "aslfeat.tar")  # the published one goes first
    assert find_weights("aslfeat").path.name == "aslfeat.tar"
    other = write(folder / "best_deeplabv3plus_resnet101_cityscapes_os16.pth.tar")
    assert find_weights("deeplabv3plus-resnet101").path == other


def test_what_is_missing_is_told(folder: Path) -> None:
    told = {
        "xfeat": (
            f"no xfeat.pt or xfeat.onnx in {folder}; published at https://github.com/verlab/"
            "accelerated_features; run: megloc weights fetch xfeat"
        ),
        "superglue_outdoor": (
            "(for noncommercial research at academic or non-profit organizations; not to be passed "
            "on); run: megloc weights fetch superglue_outdoor --accept-licence"
        ),
        "aslfeat": (
            "download it from https://github.com/lzx551402/ASLFeat and run: megloc weights add FILE"
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
    file = find_weights("superpoint_v1")
    with pytest.raises(DataError) as error:
        read_weights(file)
    known = registry()["superpoint_v1"].files[0].sha256
    assert str(error.value).startswith(
        f"{path}: is not the published file of superpoint_v1: sha256 {sha256_of(file)} instead of "
        f"{known}; "
    )


def test_links_do_not_leave_the_folder(folder: Path, tmp_path: Path) -> None:
    outside = write(tmp_path / "elsewhere" / "superpoint_v6_from_tf.pth")
    (folder / "superpoint_v6_from_tf.pth").symlink_to(outside)
    with pytest.raises(DataError, match="a link that leaves"):
        find_weights("superpoint_v6_from_tf")
    (folder / "superpoint_v6_from_tf.pth").unlink()
    (folder / "net").symlink_to(outside.parent)
    with pytest.raises(DataError, match="a link that leaves"):
        find_weights("superpoint_v6_from_tf")
    (folder / "net").unlink()
    write(folder / "real.pth").rename(folder / "v6.bin")
    (folder / "superpoint_v6_from_tf.pth").symlink_to("v6.bin")
    assert read_weights(find_weights("superpoint_v6_from_tf"))


def test_a_tensorflow_checkpoint_is_all_its_files(folder: Path) -> None:
    index, data = "model.ckpt-380000.index", "model.ckpt-380000.data-00000-of-00001"
    shutil.copy(BUNDLE / "graph.ckpt-7.index", folder / index)
    with pytest.raises(DataError, match=f"{data}: no such file, though the index beside it names"):
        read_weights(find_weights("aslfeat"))
    alone = find_weights("aslfeat")
    shutil.copy(BUNDLE / "graph.ckpt-7.data-00000-of-00001", folder / data)
    file = find_weights("aslfeat")
    assert file.size > alone.size and file.parts() == [folder / index, folder / data]
    assert read_weights(file)["global_step"] == -7
    both = (folder / index).read_bytes() + (folder / data).read_bytes()
    assert sha256_of(file) == hashlib.sha256(both).hexdigest()


def test_looking_for_weights_does_not_import_torch() -> None:
    code = (
        "import sys, megloc_kapture.io.weights as w\n"
        "try: w.find_weights('aslfeat')\n"
        "except w.MissingWeightsError: pass\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# ------------------------------------------------------------------------------------- adding


def test_add_recognises_by_sha256(published: Path, folder: Path, tmp_path: Path) -> None:
    source = tmp_path / "download (1).bin"
    shutil.copyfile(published / "aliked" / "aliked-t16.pth", source)
    added = add_weights(source)
    assert (added.name, added.path) == ("aliked-t16", folder / "aliked-t16.pth")
    assert added.path.read_bytes() == source.read_bytes()
    assert add_weights(source) == added  # once more is no fault
    assert [path.name for path in folder.iterdir()] == ["aliked-t16.pth"]


def test_add_recognises_by_name(folder: Path, tmp_path: Path) -> None:
    source = write(tmp_path / "best_deeplabv3plus_resnet101_cityscapes_os16.pth.tar")
    added = add_weights(source)
    assert added.path == folder / "best_deeplabv3plus_resnet101_cityscapes_os16.pth"
    assert find_weights("deeplabv3plus-resnet101") == added and source.is_file()


def test_add_by_name_given(folder: Path, tmp_path: Path) -> None:
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


def test_add_refuses(folder: Path, tmp_path: Path) -> None:
    wrong = write(tmp_path / "superpoint_v1.pth")
    with pytest.raises(DataError, match=r"published superpoint_v1\.pth .* instead of 52b67"):
        add_weights(wrong)
    broken = tmp_path / "vgg16_netvlad.pth"
    broken.write_bytes(b"<html>sign in</html>")
    with pytest.raises(DataError, match="no file of weights that can be read"):
        add_weights(broken)
    unknown = tmp_path / "TokyoTM_struct.mat"
    unknown.write_bytes(b"MATLAB 5.0 MAT-file")
    with pytest.raises(DataError, match="TokyoTM_struct"):
        add_weights(unknown)
    with pytest.raises(DataError, match="no such file"):
        add_weights(tmp_path / "nowhere.pth")
    assert list(folder.iterdir()) == []


def test_a_file_that_is_not_the_published_one_is_taken_when_asked(
    folder: Path, tmp_path: Path
) -> None:
    own = write(tmp_path / "superpoint_v1.pth", 3.0)
    added = add_weights(own, unverified=True)
    assert added.path == folder / "unverified" / "superpoint_v1.pth"
    found = find_weights("superpoint_v1")
    assert found.path == added.path and found.published is None
    assert read_weights(found).keys() == read_weights(describe("own", own)).keys()
    # the published one comes first, and is checked
    shutil.copyfile(own, folder / "superpoint_v1.pth")
    with pytest.raises(DataError, match="is not the published file"):
        read_weights(find_weights("superpoint_v1"))
    broken = tmp_path / "vgg16_netvlad.pth"
    broken.write_bytes(b"<html>sign in</html>")
    with pytest.raises(DataError, match="no file of weights that can be read"):
        add_weights(broken, unverified=True)


def test_add_does_not_replace_without_being_asked(folder: Path, tmp_path: Path) -> None:
    place = write(folder / "vgg16_netvlad.pth", 1.0)
    before = place.read_bytes()
    source = write(tmp_path / "vgg16_netvlad.pth", 2.0)
    with pytest.raises(OutputError, match="a different file stands there; -f replaces it"):
        add_weights(source)
    assert place.read_bytes() == before
    add_weights(source, force=True)
    assert place.read_bytes() == source.read_bytes()


def test_add_a_tensorflow_checkpoint(folder: Path, tmp_path: Path) -> None:
    for ending in (".index", ".data-00000-of-00001"):
        shutil.copy(BUNDLE / f"graph.ckpt-7{ending}", tmp_path / f"model.ckpt-9{ending}")
    added = add_weights(tmp_path / "model.ckpt-9.index", name="aslfeat")
    assert added.path == folder / "model.ckpt-380000.index"
    assert read_weights(find_weights("aslfeat"))["global_step"] == -7


# --------------------------------------------------------------------------------- converting


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


def test_convert_views_of_one_memory(tmp_path: Path) -> None:
    whole = torch.arange(6.0)
    torch.save({"a": whole, "b": whole[2:4], "c": whole.reshape(2, 3).T}, tmp_path / "x.pth")
    convert_weights(tmp_path / "x.pth", tmp_path / "x.safetensors")
    found = read_weights(find_weights(str(tmp_path / "x.safetensors")))
    assert found["b"].tolist() == [2, 3] and found["c"].tolist() == [[0, 3], [1, 4], [2, 5]]


def test_convert_refuses(tmp_path: Path) -> None:
    source, place = write(tmp_path / "x.pth"), tmp_path / "x.safetensors"
    refusals: list[tuple[Path, Path, type[MeglocError], str]] = [
        (source, tmp_path / "x.npz", OptionError, "must end in .safetensors"),
        (tmp_path / "y.pth", place, DataError, "no such file"),
    ]
    for wrong, target, kind, message in refusals:
        with pytest.raises(kind, match=message):
            convert_weights(wrong, target)
    convert_weights(source, place)
    with pytest.raises(OutputError, match="stands there; -f replaces it"):
        convert_weights(source, place)
    convert_weights(source, place, force=True)


# ------------------------------------------------------ shared by the processes of a machine

CLUSTERS, OUTPUT = 64, 1024


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """OpenIBL's layout with random weights, 190 MB of them."""
    torch.manual_seed(0)
    net = VggNetVlad(order="kd", mean_rgb=(0, 0, 0), num_clusters=CLUSTERS, output_size=OUTPUT)
    path = tmp_path_factory.mktemp("weights") / "openibl.pth"
    torch.save(net.state_dict(), path)
    return path


def described(path: Path) -> tuple[np.ndarray, int, int]:
    """A vector; bytes of the process, pages of several divided among them, before and after."""
    before = _proportional_bytes()
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    options = OpenIblOptions(weights=str(path), max_size_px=32, device="cpu")
    found = OpenIbl(options).describe(image)
    time.sleep(1.0)  # the other one has it as well
    return found, before, _proportional_bytes()


def _proportional_bytes() -> int:
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").is_file(), reason="Linux tells it")
def test_workers_have_one_copy(checkpoint: Path) -> None:
    alone, _, _ = described(checkpoint)
    with open_executor("processes", 2) as executor:
        assert executor is not None
        list(executor.map(_imported, range(8)))
        results = list(executor.map(described, [checkpoint] * 2))
    for found, _, _ in results:
        np.testing.assert_array_equal(found, alone)
    taken = sum(after - before for _, before, after in results)
    size = checkpoint.stat().st_size
    assert taken < 1.9 * size  # with two copies 2.5 times


def _imported(_: int) -> None:
    import megloc_kapture.features.global_networks  # noqa: F401

    torch.ones(64, 64) @ torch.ones(64, 64)
    time.sleep(0.1)


def test_what_was_read_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "own.pth"
    tensors = {"a": torch.rand(3, 4), "half": torch.rand(5).half(), "t": torch.rand(4, 2).T}
    torch.save(tensors, path)
    monkeypatch.setattr(weights_module, "_shared_folder", None)
    share_weights(tmp_path / "shared")
    try:
        file = describe("own", path)
        first = read_weights(file)  # the folder is not there: as without
        (tmp_path / "shared").mkdir()
        second, third = read_weights(file), read_weights(file)
        path.write_bytes(b"something else")
        fourth = read_weights(file)
    finally:
        share_weights(None)
    assert not getattr(first["a"], "is_shared_file", False)
    for found in (first, second, third, fourth):
        assert found.keys() == tensors.keys()
        for name, tensor in tensors.items():
            assert torch.equal(found[name], tensor) and found[name].dtype == tensor.dtype
    assert second["a"].is_shared_file  # type: ignore[attr-defined]
