"""Photographs with their cameras, and clients, for the tests of the service."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from megloc_kapture import Camera, Localizer
from megloc_kapture.service.app import Service, make_app
from megloc_kapture.service.server import map_overview


@dataclass(frozen=True)
class Photo:
    """A query image: its file, its camera, and that as the service takes it."""

    path: Path
    camera: Camera

    @property
    def content(self) -> bytes:
        return self.path.read_bytes()

    def camera_json(self, **changed: Any) -> str:
        names = ("model", "width", "height", "params")
        return json.dumps({name: getattr(self.camera, name) for name in names} | changed)

    def form(self, camera: str | None = None) -> dict[str, Any]:
        return {
            "files": {"image": ("photo.jpg", self.content, "image/jpeg")},
            "data": {"camera": self.camera_json() if camera is None else camera},
        }


def client_of(localizer: Localizer, **limits: Any) -> TestClient:
    """A client of a service; defects of the service are answers, as they are over a network."""
    app = make_app(Service(localizer, **limits), map_overview(localizer.map))
    return TestClient(app, raise_server_exceptions=False)
