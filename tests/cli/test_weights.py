"""``megloc weights``, with a registry of files that a local server delivers."""

from __future__ import annotations

import hashlib
import io
import re
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import torch

from megloc_kapture.cli import weights as weights_command
from megloc_kapture.io import weights


def saved(value: float) -> bytes:
    out = io.BytesIO()
    torch.save({"a": torch.tensor([value])}, out)
    return out.getvalue()


FREE, BOUND, UNKNOWN = saved(1.0), saved(2.0), saved(3.0)
OF_MODERN = ("aliked-n16", "aliked_lightglue")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder of a local server, and a registry of its files."""
    folder = tmp_path / "served"
    folder.mkdir()
    files = {"free": FREE, "bound": BOUND, "unknown": UNKNOWN, **dict.fromkeys(OF_MODERN, FREE)}
    for name, content in files.items():
        (folder / f"{name}.pth").write_bytes(content)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path / "weights"))
    running = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    table = tmp_path / "registry.toml"
    table.write_text(registry_text(f"http://127.0.0.1:{running.server_port}"))
    monkeypatch.setattr(weights, "_REGISTRY", table)
    weights.registry.cache_clear()
    yield folder
    weights.registry.cache_clear()
    running.shutdown()
    thread.join()
    running.server_close()


def registry_text(address: str) -> str:
    def entry(name: str, content: bytes | None, *, commercial: str = "true") -> str:
        lines = [
            *(f"[{name}]", 'purpose = "finds"', f'page = "{address}/page"'),
            *('licence = "SHORT"', 'terms = "for looking at only"', f"commercial = {commercial}"),
            *(f"[[{name}.files]]", f'name = "{name}.pth"'),
        ]
        if name != "by-hand":
            lines.append(f'url = "{address}/{name}.pth"')
        if content is not None:
            lines.append(f"size = {len(content)}")
            lines.append(f'sha256 = "{hashlib.sha256(content).hexdigest()}"')
        return "\n".join(lines) + "\n"

    bound = entry("bound", BOUND, commercial="false")
    others = [entry(name, None) for name in ("unknown", "by-hand")]
    of_modern = [entry(name, FREE) for name in OF_MODERN]
    return "".join([entry("free", FREE), bound, *others, *of_modern])


@pytest.fixture
def folder(served: Path) -> Path:
    return served.parent / "weights"


def test_fetch_downloads_and_checks_files(megloc: Any, folder: Path) -> None:
    done = megloc("weights", "fetch", "free", "unknown")
    assert done.status == 0
    free, unknown = done.out.splitlines()
    assert free == f"free: {folder}/free.pth ({len(FREE)} bytes, sha256 correct)"
    assert unknown.endswith(
        f"sha256 {hashlib.sha256(UNKNOWN).hexdigest()}; the registry lists no sha256)"
    )
    assert "licence: SHORT: for looking at only" in done.err
    assert (folder / "free.pth").read_bytes() == FREE
    (folder / "by-hand.pth").write_bytes(FREE)
    by_hand = megloc("weights", "fetch", "by-hand").out
    assert by_hand == f"by-hand: already present, {folder}/by-hand.pth\n"
    again = megloc("weights", "fetch", "free", "-q")
    assert (again.out, again.err) == (f"free: already present, {folder}/free.pth\n", "")


def test_fetch_downloads_the_files_of_a_preset(megloc: Any, folder: Path) -> None:
    fetched = megloc("weights", "fetch", "--preset", "modern", "-q").out.splitlines()
    places = [f"{name}: {folder}/{name}.pth" for name in OF_MODERN]
    assert [line.partition(" (")[0] for line in fetched] == places
    again = megloc("weights", "fetch", "--preset", "modern").out
    assert again == "modern: no weights are missing\n"
    megloc("weights", "fetch", "--preset", "moden").refused("did you mean 'modern'")


def test_eval_names_all_missing_weights_of_a_preset(
    megloc: Any, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path / "none"))
    done = megloc("eval", "kapture", "--root", scene, "--preset", "megloc", "--dry-run")
    lines = done.err.splitlines()
    assert done.status == 2 and len(lines) > 5
    assert all(line.startswith("megloc: the weights ") for line in lines[:-1])
    assert all(len(line) < 500 for line in lines)
    assert "megloc weights fetch --preset megloc" in lines[-1]
    lightglue = ("name=lightglue", "options.weights=aliked_lightglue")
    sets = [part for each in lightglue for part in ("--set", f"second_matching.matcher.{each}")]
    command = ("eval", "kapture", "--root", scene, *sets, "--dry-run")
    done = megloc(*command)
    assert done.status == 2 and done.out == ""
    assert done.err.startswith("megloc: the weights aliked_lightglue are missing: ")
    # lifted maps have no pairs to match again
    of_map = ("--set", "map=lift", "--set", "second_matching.queries=false")
    assert "lightglue" not in megloc(*command, *of_map).err


def test_a_restricted_licence_needs_consent_before_any_download(megloc: Any, folder: Path) -> None:
    message = megloc("weights", "fetch", "free", "bound").refused(
        r"bound needs your consent to its licence: SHORT: for looking at only \(full text at http",
        "add --accept-licence",
    )
    assert "free needs" not in message
    assert not folder.exists()
    assert megloc("weights", "fetch", "bound", "--accept-licence").status == 0
    assert (folder / "bound.pth").read_bytes() == BOUND


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "choose weights to fetch: free, bound"),
        (("fre",), "no weights 'fre' in the registry; did you mean 'free'\\? there are"),
        (("by-hand",), "no automatic download: .*by-hand .*megloc weights add FILE"),
    ],
)
def test_weights_that_cannot_be_fetched_are_refused(
    megloc: Any, folder: Path, names: tuple[str, ...], message: str
) -> None:
    megloc("weights", "fetch", *names).refused(message)
    assert not folder.exists()


def test_a_different_file_is_replaced_only_by_force(megloc: Any, folder: Path) -> None:
    folder.mkdir()
    (folder / "free.pth").write_bytes(BOUND)
    fetch = ("weights", "fetch", "free", "-q")
    megloc(*fetch).refused("exists, but is not the published file")
    assert megloc(*fetch, "-f").status == 0
    assert (folder / "free.pth").read_bytes() == FREE


def test_wrong_and_missing_downloads_are_refused(megloc: Any, served: Path) -> None:
    (served / "unknown.pth").write_bytes(b"something else")
    megloc("weights", "fetch", "unknown", "-q").refused("not weights that torch")
    (served / "free.pth").write_bytes(BOUND)
    megloc("weights", "fetch", "free", "-q").refused("expected sha256:.* but got")
    (served / "free.pth").unlink()
    megloc("weights", "fetch", "free", "-q").refused("the server answers 404")


def test_files_are_listed_and_damaged_and_missing_ones_named(megloc: Any, folder: Path) -> None:
    megloc("weights", "check").refused("no weights to check")
    folder.mkdir()
    (folder / "free.pth").write_bytes(FREE)
    rows = [line.split() for line in megloc("weights", "list").out.splitlines()]
    states = {row[0]: row[-2:] for row in rows[1:5]}
    assert states["free"] == ["present", "known"] and states["bound"] == ["missing", "known"]
    assert megloc("weights", "check").out.endswith("all files are correct\n")
    (folder / "free.pth").write_bytes(FREE[:-1])
    done = megloc("weights", "check")
    assert done.status == 2 and done.out.endswith("wrong files: 1\n")
    assert re.search(r"wrong: .*free\.pth: is not the published free\.pth of free", done.out)
    done = megloc("weights", "check", "bound")
    assert done.status == 2 and "run: megloc weights fetch bound --accept-licence" in done.out


@pytest.mark.parametrize(
    ("versions", "problem"),
    [
        ({"torch": "2.5.1+cpu", "torchvision": "0.20.1"}, "pip uninstall torchvision"),
        ({"torch": "2.5.1+cpu", "torchvision": "0.20.1+cpu"}, ""),
        ({"opencv-python": "4", "opencv-python-headless": "4"}, "both write the folder cv2"),
        ({"opencv-python": "4"}, ""),
    ],
)
def test_packages_that_conflict_are_found(
    monkeypatch: pytest.MonkeyPatch, versions: dict[str, str], problem: str
) -> None:
    monkeypatch.setattr(weights_command, "installed_version", versions.get)
    problems = weights_command.find_problems()
    assert len(problems) == bool(problem) and problem in "".join(problems)
