"""Map images with poses, localize other images in the map, and evaluate their poses.

    python examples/map_and_evaluate.py SCENE

SCENE has kapture folders mapping/ (with poses), query/ and query_gt/ (the queries' poses).
"""

import sys
from pathlib import Path

import megloc_kapture as megloc


def main(scene: Path) -> None:
    m = megloc.build_map(scene / "mapping", workspace="example_run")
    found = m.localize(scene / "query")
    for name, result in found.items():
        print(f"{name}: {result.cam_from_world.center() if result else result.reason}")
    found.save("example_localized", force=True)
    evaluation = megloc.evaluate("example_localized", truth=scene / "query_gt")
    print(evaluation)
    evaluation.html("example_report.html")
    megloc.export("ply", "example_scene.ply", map=m.kapture_map, query="example_localized")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
