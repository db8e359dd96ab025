"""Weights brought into their folder: downloaded, added from a file, converted.

A download goes on where it stopped, and gets its name only when it is right: what has arrived lies
beside the file (``.NAME.part``), with what tells one state of the file on the server from another
(``.NAME.part.json``). The rest is asked for with ``Range`` and, so that two states are never
joined, ``If-Range`` (RFC 9110, sections 13.1.5 and 14.2).
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import http.client
import io
import os
import re
import shutil
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from megloc_kapture.errors import DataError, MeglocError, OptionError, OutputError
from megloc_kapture.io.files import (
    atomic_write,
    output_error,
    read_json_model,
    write_bytes,
    write_json_model,
)
from megloc_kapture.io.weights import (
    UNVERIFIED,
    PublishedFile,
    Weights,
    WeightsFile,
    by_file_name,
    by_sha256,
    describe,
    lookup,
    read_weights,
    registry,
    sha256_of,
    weights_folder,
)

SOURCE_KEY = "source_sha256"  # of a converted file's metadata
CHUNK = 1 << 20
_TIMEOUT_S = 60.0
# bytes that come, and how many chunks of them there will be; yields them again
Watch = Callable[[Iterator[bytes], int], Iterable[bytes]]


class TransferError(MeglocError):
    """The server cannot be reached, refuses, or the transfer broke; says how to go on."""


class _Partial(BaseModel):
    """The file that the bytes which have arrived are the beginning of."""

    url: str
    validator: str
    total: int


def fetch(
    url: str,
    path: Path,
    *,
    size: int | None = None,
    sha256: str | None = None,
    watch: Watch = lambda chunks, _: chunks,
) -> str:
    """Download a file, going on with what an earlier try left beside its path; its sha256.

    Parameters
    ----------
    size, sha256 : what the file must have, where that is known.
    watch : sees the chunks go by, to show progress.

    Raises
    ------
    TransferError : the server cannot be reached or refuses, or the transfer broke; what has
        arrived stays, and the next call goes on with it.
    DataError : what came is not the file; it is removed again.
    OutputError : it cannot be written, for one because the disk is full; what has arrived stays.
    """
    part = path.with_name(f".{path.name}.part")
    state_path = part.with_name(f"{part.name}.json")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(part, "a+b") as file:
            _lock(file, part, path)
            try:
                _transfer(url, file, state_path, watch, expected=size)
            except OSError as error:
                failed = output_error(part, error)
                if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                    text = f"{failed}; make room and run the same command again to go on"
                    failed = OutputError(text)
                raise failed from error
            found = _check(file, url, size, sha256)
            os.replace(part, path)
            state_path.unlink(missing_ok=True)
    except DataError:
        part.unlink(missing_ok=True)
        state_path.unlink(missing_ok=True)
        raise
    except OSError as error:
        raise output_error(path, error) from error
    return found


def _transfer(
    url: str, file: io.BufferedRandom, state_path: Path, watch: Watch, *, expected: int | None
) -> None:
    """Bring the rest, or all of it where the server does not give the rest of the same state."""
    have = file.seek(0, os.SEEK_END)
    state = None
    with suppress(DataError):  # not there, or not whole: begin again
        state = read_json_model(state_path, _Partial)
    if state is None or state.url != url or have > state.total:
        state, have = None, 0
    elif have == state.total:
        return
    with _opened(url, have, state) as response:
        start = 0
        if response.status == http.HTTPStatus.PARTIAL_CONTENT:
            told = re.fullmatch(
                r"bytes (\d+)-(\d+)/(\d+)", response.headers.get("Content-Range", "")
            )
            if not (told and state and (int(told[1]), int(told[3])) == (have, state.total)):
                state_path.unlink(missing_ok=True)
                raise TransferError(
                    f"{url}: the server sends another part of the file than asked for; run the "
                    "same command again to begin anew"
                )
            start = have
        if response.headers.get_content_type() == "text/html":
            raise TransferError(f"{url}: a web page came instead of the file; fetch it by hand")
        length = response.headers.get("Content-Length")
        rest = int(length) if length is not None and length.isdigit() else None
        total = expected if rest is None else start + rest
        file.truncate(start)
        file.seek(start)
        _remember(state_path, url, response, total)
        free = shutil.disk_usage(os.fspath(file.name)).free
        if rest is not None and free < rest:
            no_space = os.strerror(errno.ENOSPC)
            raise OSError(errno.ENOSPC, f"{no_space} ({rest} bytes, {free} are free)")
        for chunk in watch(_chunks(response, url, total, start), -(-(rest or 0) // CHUNK)):
            file.write(chunk)
        file.flush()


def _opened(url: str, have: int, state: _Partial | None) -> http.client.HTTPResponse:
    request = urllib.request.Request(url, headers={"User-Agent": "megloc-kapture"})
    if have and state is not None:
        request.add_header("Range", f"bytes={have}-")
        request.add_header("If-Range", state.validator)
    opener = urllib.request.build_opener(SafeRedirects)
    try:
        return opener.open(request, timeout=_TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and have:
            return _opened(url, 0, None)
        raise TransferError(f"{url}: the server answers {error.code} {error.reason}") from error
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or error or type(error).__name__
        raise TransferError(f"{url}: cannot be reached: {reason}") from error


class SafeRedirects(urllib.request.HTTPRedirectHandler):
    """Redirections are followed, but never from https to what anybody on the way can change."""

    def redirect_request(  # noqa: D102
        self,
        req: urllib.request.Request,
        fp: object,
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
        newurl: str,
    ) -> urllib.request.Request | None:
        if not newurl.startswith(("https:",) if req.type == "https" else ("https:", "http:")):
            raise TransferError(f"{req.full_url}: leads to {newurl}, which is not safe")
        return super().redirect_request(req, fp, code, msg, headers, newurl)  # type: ignore[arg-type]


def _chunks(
    response: http.client.HTTPResponse, url: str, total: int | None, start: int
) -> Iterator[bytes]:
    have, broke = start, None
    try:
        while chunk := response.read(CHUNK):
            have += len(chunk)
            yield chunk
    except (OSError, http.client.HTTPException) as error:
        broke = error
    # a connection that is closed early reads as the end of the file
    if broke or (total is not None and have < total):
        whole = "" if total is None else f" of {total}"
        raise TransferError(
            f"{url}: the transfer broke after {have}{whole} bytes; run the same command again to "
            "go on"
        ) from broke


def _remember(path: Path, url: str, response: http.client.HTTPResponse, total: int | None) -> None:
    """Keep what a continuation needs; nothing where the server gives no strong validator."""
    validator = response.headers.get("ETag") or response.headers.get("Last-Modified")
    if validator is None or validator.startswith("W/") or total is None:
        path.unlink(missing_ok=True)
    else:
        write_json_model(path, _Partial(url=url, validator=validator, total=total))


def _lock(file: io.BufferedRandom, part: Path, path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # between opening and locking it may have been finished, and have got its name
        ours = part.exists() and os.path.samestat(os.fstat(file.fileno()), part.stat())
    except BlockingIOError:
        ours = False
    if not ours:
        raise OutputError(f"{path}: another megloc is fetching it")


def _check(file: io.BufferedRandom, url: str, size: int | None, sha256: str | None) -> str:
    file.seek(0)
    found = hashlib.file_digest(file, "sha256").hexdigest()
    have = file.tell()
    if sha256 is not None and found != sha256:
        raise DataError(
            f"what came is not the published file: sha256 {found} instead of {sha256} "
            f"({have} bytes); it was removed",
            path=url,
        )
    if size is not None and have != size:
        raise DataError(f"{have} bytes came instead of {size}; they were removed", path=url)
    if not have:
        raise DataError("an empty file came", path=url)
    return found


# ------------------------------------------------------------------------------- added, converted


def add_weights(
    source: Path, *, name: str | None = None, force: bool = False, unverified: bool = False
) -> WeightsFile:
    """Copy a file into the folder of weights under the name it is looked for by.

    Parameters
    ----------
    source : the file; never changed. Of a TensorFlow checkpoint its ``.index``.
    name : the network it is for; found out by the sha256 or the file's name unless given.
    force : replace a different file that stands there.
    unverified : take it though it is not the published file, e.g. one trained anew. It is kept in
        a folder of its own, ``unverified``, and is found where the published one is not there.

    Raises
    ------
    DataError : it cannot be read safely, or is not the published file.
    OptionError : what it is cannot be told.
    OutputError : a different file stands there, or it cannot be written.
    """
    if not source.is_file():
        raise DataError("no such file", path=source)
    found = describe(source.name, source)
    sha256 = sha256_of(found)
    weights, target = _recognised(source, sha256, name)
    expected = next((f for f in weights.files if f.name == target), None)
    prove(found, sha256, None if unverified else expected, weights)
    path = weights_folder() / (f"{UNVERIFIED}/{target}" if unverified else target)
    if path.exists() and not force:
        if sha256_of(describe(weights.name, path)) == sha256:
            return describe(weights.name, path)
        raise OutputError(f"{path}: a different file stands there; -f replaces it")
    # the index comes last: with it the checkpoint is there
    for part in reversed(found.parts()):
        ending = part.name.removeprefix(source.stem)
        beside = path if part == source else path.with_name(path.stem + ending)
        with open(part, "rb") as content, atomic_write(beside) as copy:
            shutil.copyfileobj(content, copy)
    return describe(weights.name, path)


def prove(
    file: WeightsFile, sha256: str, published: PublishedFile | None, weights: Weights
) -> None:
    """Raise DataError unless a file is what is published, or can be read safely.

    Parameters
    ----------
    sha256 : of the file.
    published : what it should be; None: converted, of which no checksum is known.
    """
    if published and published.sha256 and sha256 != published.sha256:
        raise DataError(
            f"is not the published {published.name} of {weights.name}: "
            f"sha256 {sha256} instead of {published.sha256}",
            path=file.path,
        )
    read_weights(file)


def convert_weights(source: Path, output: Path, *, force: bool = False) -> int:
    """Write all tensors of a checkpoint, with its sha256, and return their number.

    The same file gives the same bytes.

    Parameters
    ----------
    source : the checkpoint; never changed. Names and layouts of its tensors are kept.
    output : the file to write, ``.safetensors``.
    force : replace a file that stands there.

    Raises
    ------
    DataError : it cannot be read safely.
    OptionError : the ending is another one.
    OutputError : a file stands there, or it cannot be written.
    """
    from safetensors.torch import save

    if output.suffix != ".safetensors":
        raise OptionError(f"{output}: the file to write must end in .safetensors")
    if output.exists() and not force:
        raise OutputError(f"{output}: stands there; -f replaces it")
    if not source.is_file():
        raise DataError("no such file", path=source)
    file = describe(source.name, source)
    # views of one memory are stored one by one
    tensors = {name: tensor.contiguous().clone() for name, tensor in read_weights(file).items()}
    # one key only: the library writes several in no fixed order
    write_bytes(output, save(tensors, {SOURCE_KEY: sha256_of(file)}))
    return len(tensors)


def _recognised(source: Path, sha256: str, name: str | None) -> tuple[Weights, str]:
    """The network, and the name the file gets."""
    if name is None:
        found = by_sha256(sha256) or by_file_name(source.name)
        if found is not None:
            return found[0], found[1].name
        if source.suffix == ".safetensors" and source.stem in registry():
            return registry()[source.stem], source.name
        raise OptionError(
            f"{source}: neither its sha256 nor its name is in the registry; say what it is with "
            "--name (megloc weights list)"
        )
    weights = lookup(name)
    if source.suffix == ".safetensors":
        return weights, weights.converted
    same = [file for file in weights.files if file.sha256 == sha256]
    named = [file for file in weights.files if source.name in file.names]
    alike = [file for file in weights.files if Path(file.name).suffix == source.suffix]
    for file in (*same, *named, *alike):
        return weights, file.name
    names = ", ".join(file.name for file in weights.files)
    raise OptionError(f"{source}: {name} is kept as {names} or {weights.converted}")
