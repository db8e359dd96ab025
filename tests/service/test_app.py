"""The service: answers are those of ``Localizer``; whatever else comes is refused in one line."""

from __future__ import annotations

import io
import itertools
import re
import threading
from base64 import b64encode
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx2
import numpy as np
import pytest
from images import photograph
from PIL import Image
from serving import Photo, client_of
from starlette.testclient import TestClient

from megloc_kapture import Localizer, Pose
from megloc_kapture.api import Map
from megloc_kapture.errors import DataError
from megloc_kapture.service.app import Answer
from megloc_kapture.values import RigidTransform

PINHOLE = '{"model": "SIMPLE_PINHOLE", "width": 400, "height": 300, "params": [300, 200, 150]}'
# of the machine: no answer has one in it
PATH = re.compile(r"/(home|root|usr|tmp|work|var|opt)/|\.py\b|Traceback")


def refused(answer: httpx2.Response, status: int, *words: str) -> str:
    assert answer.status_code == status, answer.text
    assert set(answer.json()) == {"error"}
    error: str = answer.json()["error"]
    assert not PATH.search(answer.text)
    for word in words:
        assert re.search(word, error), error
    return error


def picture(width: int, height: int, form: str = "PNG") -> bytes:
    content = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    Image.fromarray(noise).save(content, form)
    return content.getvalue()


def test_answers_equal_the_localizer(
    client: TestClient, localizer: Localizer, photos: list[Photo]
) -> None:
    photo = photos[0]
    answer = client.post("/localize", **photo.form())
    actual = localizer.localize(photo.path, photo.camera)
    assert answer.status_code == 200 and isinstance(actual, Pose)
    body = answer.json()
    assert body["localized"] is True and body["reason"] is None
    assert tuple(body["cam_from_world"]["quat_wxyz"]) == actual.cam_from_world.quat_wxyz
    assert tuple(body["cam_from_world"]["translation"]) == actual.cam_from_world.translation
    assert body["camera_center"] == actual.cam_from_world.center().tolist()
    assert actual.covariance is not None and body["covariance"] == actual.covariance.tolist()
    assert body["confidence"] == actual.confidence
    numbers = (body["num_matches"], body["num_inliers"], tuple(body["candidates"]))
    assert numbers == (actual.num_matches, actual.num_inliers, actual.candidates)
    camera = body["camera"]
    assert tuple(camera["params"]) == photo.camera.params and camera["width"] == 400
    in_the_address = client.post(
        f"/localize?camera={quote(photo.camera_json())}",
        content=photo.content,
        headers={"content-type": "image/jpg"},  # not registered, but common
    )
    assert in_the_address.content == answer.content
    files = {"image": photo.content, "camera": photo.camera_json().encode()}  # curl -F camera=@FILE
    assert client.post("/localize", files=files).content == answer.content
    # the documentation describes this answer
    api = client.get("/openapi.json").json()
    call = api["paths"]["/localize"]["post"]
    assert set(call["requestBody"]["content"]) == {"multipart/form-data", "image/jpeg", "image/png"}
    model = api["components"]["schemas"]["Answer"]
    assert set(body) == set(model["properties"]) == set(model["required"])
    assert set(camera) == set(api["components"]["schemas"]["Camera"]["properties"])


def test_an_answer_counts_matches_and_inliers_and_names_the_frame(photos: list[Photo]) -> None:
    pose = Pose(RigidTransform.identity(), 9, 7)
    answer = Answer.of(pose, photos[0].camera, "DUC1")
    assert (answer.num_matches, answer.num_inliers, answer.frame) == (9, 7, "DUC1")


@pytest.mark.parametrize(("orientation", "focal_35mm"), [(6, 27), (1, 0)])
def test_photographs_without_camera_equal_the_localizer(
    client: TestClient,
    localizer: Localizer,
    photos: list[Photo],
    tmp_path: Path,
    orientation: int,
    focal_35mm: int,
) -> None:
    path = tmp_path / "photo.jpg"
    photograph(photos[0].path, path, orientation=orientation, focal_35mm=focal_35mm)
    actual = Map(localizer.map, localizer.options).localize(path)
    body = client.post("/localize", content=path.read_bytes()).json()
    assert isinstance(actual, Pose) and actual.camera is not None
    assert tuple(body["cam_from_world"]["quat_wxyz"]) == actual.cam_from_world.quat_wxyz
    assert tuple(body["cam_from_world"]["translation"]) == actual.cam_from_world.translation
    assert body["camera"]["params"] == list(actual.camera.params)
    assert (body["camera"]["width"], body["camera"]["height"]) == (400, 298)
    assert body["remarks"] == list(actual.remarks)


def test_an_unrelated_photograph_fails_with_a_reason(client: TestClient) -> None:
    form = {"files": {"image": picture(400, 300)}, "data": {"camera": PINHOLE}}
    answer = client.post("/localize", **form)
    assert answer.status_code == 200
    body = answer.json()
    assert body["localized"] is False and body["cam_from_world"] is None
    assert re.search("match|agree|confidence", body["reason"])


def test_the_page_needs_no_network(client: TestClient) -> None:
    page = client.get("/")
    assert page.status_code == 200 and page.headers["content-type"].startswith("text/html")
    assert not re.search(r"(src|href)=\"?(https?:)?//|@import|url\(", page.text)
    assert "default-src 'none'" in page.headers["content-security-policy"]


def test_the_map_from_above(client: TestClient, localizer: Localizer) -> None:
    seen = client.get("/map").json()
    axes = np.array([seen["right"], seen["up"]])
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-8)
    centers = np.array([pose.center() for pose in localizer.map.poses.values()])
    np.testing.assert_allclose(seen["origin"], centers.mean(axis=0))
    flat = np.reshape(seen["cameras"], (-1, 4))
    np.testing.assert_allclose(flat[:, :2], (centers - seen["origin"]) @ axes.T, rtol=1e-3)
    assert seen["images"] == len(flat) == 7 and len(seen["points"]) > 200


@pytest.mark.parametrize(
    "camera, words",
    [
        ("PINHOLE,400,300,300,300,200,150", 'camera: Invalid JSON.*as in {"model": "PINHOLE"'),
        ({"model": "FISHEYE"}, "unknown camera model 'FISHEYE'; known: "),
        ({"width": 4000}, "the image is 400x300 as stored, but its camera says 4000x300"),
        ({"path": "/etc/passwd"}, "camera.path: Unexpected keyword argument"),
    ],
)
def test_invalid_cameras_are_refused(
    client: TestClient, photos: list[Photo], camera: str | dict[str, Any], words: str
) -> None:
    sent = photos[0].camera_json(**camera) if isinstance(camera, dict) else camera
    refused(client.post("/localize", **photos[0].form(sent)), 422, words)


def test_misspelt_parameters_are_refused(client: TestClient, photos: list[Photo]) -> None:
    """An ignored camera would give a less accurate pose."""
    sent: dict[str, Any] = {
        "params": {"cam": photos[0].camera_json()},
        "content": photos[0].content,
    }
    refused(client.post("/localize", **sent), 422, "unknown parameter 'cam'")


@pytest.mark.parametrize(
    "content, status, words",
    [
        (b"", 415, "neither JPEG nor PNG"),
        (b64encode(picture(400, 300, "JPEG")), 415, "base64: send the bytes"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", 415, "neither"),
        (picture(400, 300, "JPEG")[:9000], 422, "broken"),
        (picture(1200, 1000), 413, "1200x1000, which is more than 1 megapixels"),
    ],
)
def test_invalid_images_are_refused(
    localizer: Localizer, content: bytes, status: int, words: str
) -> None:
    with client_of(localizer, threads=1, max_megapixels=1.0) as client:
        form = {"files": {"image": content}, "data": {"camera": PINHOLE}}
        refused(client.post("/localize", **form), status, words)


def test_other_content_types_are_refused(client: TestClient, photos: list[Photo]) -> None:
    for kind in ("application/json", "application/x-www-form-urlencoded"):
        answer = client.post("/localize", content=photos[0].content, headers={"content-type": kind})
        refused(answer, 415, f"Content-Type says {kind}: send image/jpeg")


def test_two_images_are_refused(client: TestClient, photos: list[Photo]) -> None:
    files = [("image", photo.content) for photo in photos[:2]]
    refused(client.post("/localize", files=files), 422, "a form has one file `image`")


def test_large_requests_are_refused(localizer: Localizer) -> None:
    with client_of(localizer, threads=1, max_mb=0.01) as client:
        refused(client.post("/localize", content=bytes(10_001)), 413, "larger than 0.01 MB")
        chunks = (bytes(1000) for _ in range(11))  # of a length that is not told
        refused(client.post("/localize", content=chunks), 413, "larger than 0.01 MB")
        refused(client.post("/localize", content=bytes(9_999)), 415)


def test_token_protects_localization_and_map(localizer: Localizer) -> None:
    token = "correct horse battery"
    with client_of(localizer, threads=1, token=token) as client:
        wrong = ("", "Bearer", f"Basic {token}", "Bearer correct horse batter", f"Bearer {token}s")
        for shown in (*wrong, f"bearer {token.upper()}", "Bearer \xff\xfe"):
            given = {"authorization": shown.encode("latin-1")} if shown else {}
            for method, path in (("POST", "/localize"), ("GET", "/map")):
                answer = client.request(method, path, headers=given)
                error = refused(answer, 401)
                assert token not in error and answer.headers["www-authenticate"] == "Bearer"
        for path in ("/", "/docs", "/openapi.json", "/health"):
            assert client.get(path).status_code == 200
        assert client.head("/health").status_code == 200  # as monitors ask
        right = {"authorization": f"Bearer {token}"}
        no_image = client.post("/localize", content=b"x", headers=right)
        assert no_image.status_code == 415
        assert client.get("/map", headers=right).status_code == 200


def test_a_full_queue_refuses_images(
    localizer: Localizer, photos: list[Photo], monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    localize = localizer.localize_query

    def slow(query: Any) -> Any:
        go_on.wait(30)
        return localize(query)

    monkeypatch.setattr(localizer, "localize_query", slow)
    with client_of(localizer, threads=1, max_waiting=1) as client, ThreadPoolExecutor(6) as pool:
        sent = [pool.submit(client.post, "/localize", **photos[0].form()) for _ in range(6)]
        full = [future.result() for future in itertools.islice(as_completed(sent), 4)]
        for answer in full:
            refused(answer, 503, "too many images are waiting")
            assert answer.headers["retry-after"] == "2"
        assert client.get("/health").status_code == 200
        go_on.set()
        assert sorted(future.result().status_code for future in sent) == [200] * 2 + [503] * 4


def test_internal_errors_hide_paths(
    localizer: Localizer, photos: list[Photo], monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = DataError("cannot read", path="/srv/secret/points3d.txt"), ValueError("/srv/secret")
    for error in errors:

        def fail(_: Any, error: Exception = error) -> Any:
            raise error

        monkeypatch.setattr(localizer, "localize_query", fail)
        with client_of(localizer, threads=1) as client:
            refused(client.post("/localize", **photos[0].form()), 500, "see the service's log")
