"""Localize image files in a kapture map or a COLMAP model.

python examples/localize_photographs.py MAP PHOTO [PHOTO ...]
"""

import sys

import megloc_kapture as megloc


def main(map_path: str, photographs: list[str]) -> None:
    m = megloc.open_map(map_path)
    for photograph in photographs:
        found = m.localize(photograph)
        if not found:
            print(f"{photograph}: not localized, {found.reason}")
            continue
        x, y, z = found.cam_from_world.center()
        print(f"{photograph}: {x:.3f} {y:.3f} {z:.3f}, confidence {found.confidence:.2f}")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
