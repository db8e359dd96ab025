"""Ask a running ``megloc serve`` where a photograph was taken.

    megloc serve my_map &
    python serve_client.py photo.jpg PINHOLE,1920,1080,1371,1371,960,540

The camera is MODEL,WIDTH,HEIGHT,PARAMETERS, as in COLMAP; --url and --token are the service's.
Needs only the standard library.
"""

import argparse
import json
import sys
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import Request, urlopen


def localize(photo: Path, camera: str, url: str, token: str = "") -> dict:
    """Return the service's answer: a pose, the reason for its absence, or an error."""
    model, width, height, *params = camera.split(",")
    sent = {"model": model, "width": int(width), "height": int(height)}
    sent["params"] = [float(one) for one in params]
    headers = {"Content-Type": "application/octet-stream"}
    if token:
        headers["Authorization"] = f"Bearer {token}"
    query = urlencode({"camera": json.dumps(sent)})
    request = Request(f"{url.rstrip('/')}/localize?{query}", photo.read_bytes(), headers)
    try:
        with urlopen(request, timeout=120) as answer:
            return json.load(answer)
    except HTTPError as error:
        return json.load(error)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photo", type=Path)
    parser.add_argument("camera")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--token", default="")
    found = localize(**vars(parser.parse_args()))
    print(json.dumps(found, indent=2))
    sys.exit(0 if found.get("localized") else 1)
