"""Run a dataset with two sets of options, and test whether one is better.

    python examples/compare_presets.py SCENE

SCENE is a dataset of kapture folders: mapping/, query/, query_gt/.
"""

import sys
from pathlib import Path

import megloc_kapture as megloc

VARIANTS = {
    "8 candidates": {"query_pairs.top_k": 8},
    "1 candidate": {"query_pairs.top_k": 1},
}


def main(scene: Path) -> None:
    results = []
    for label, options in VARIANTS.items():
        run = megloc.run("kapture", root=scene, set=options, workspace=f"example_{len(results)}")
        print(label, run.recall)
        results.append(megloc.evaluate(run.localized, truth=scene / "query_gt", label=label))
    print(results[0].compare(results[1]))


# worker processes import this file, and must not run main()
if __name__ == "__main__":
    main(Path(sys.argv[1]))
