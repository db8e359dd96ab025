"""Examples at the end of every help page; the tests parse them as the command does."""

from __future__ import annotations

from collections.abc import Sequence

_TEXT = """
megloc map photos/ -o my_map
megloc map photos/ walk.mp4 -o my_map --scale a.jpg b.jpg 2.35
megloc localize -i my_map --images IMG_0001.jpg holiday/ walk.mp4 -o localized
megloc localize -i my_map --query my_scene/query -o localized
megloc eval kapture --root my_scene
megloc eval kapture --root my_scene --set localization.pose.max_error_px=8 --dry-run
megloc eval aachen --root /data/Aachen-Day-Night --executor dask --scheduler tcp://host:8786
megloc import aachen /data/Aachen-Day-Night -o aachen
megloc import colmap sparse/0 --images photos --database features.db -o my_map
megloc synth -o my_scene
megloc synth aachen -o twin --seed 1
megloc preprocess -i my_scene/mapping -o smaller --resize 1600 --undistort
megloc preprocess -i my_scene/mapping -o masked --segmenter deeplabv3plus --unchanging
megloc extract-local -i my_scene/mapping -i my_scene/query -o features
megloc extract-local -i my_scene/mapping --features aliked xfeat -o features
megloc extract-global -i my_scene/mapping --query my_scene/query --features-dir features -o features
megloc pairs-mapping -i my_scene/mapping --by poses -o pairs_mapping.txt
megloc pairs-mapping -i my_scene/mapping --by retrieval --features-dir features -o pairs_mapping.txt
megloc pairs-query -i my_scene/mapping --query my_scene/query --features-dir features -o pairs.txt
megloc match -i my_scene/mapping --features-dir features --pairs pairs_mapping.txt -o matches
megloc match -i my_scene/mapping --query my_scene/query --features-dir features --pairs pairs.txt \
-o matches
megloc triangulate -i my_scene/mapping --features-dir features --features-dir matches -o map
megloc densify -i map -o map_with_depth --fuse cloud.ply
megloc densify -i map -o map_with_depth --by patchmatchnet
megloc refine-map -i map -o map_refined --set refinement.uncertainty.max_robust_sigmas=2.5
megloc refine-poses -i map --query my_scene/query --poses localized -o refined --by icp
megloc train matcher -i my_scene/mapping --held-out other_scene/mapping -o matcher.safetensors
megloc train descriptor -i my_scene/mapping --features xfeat -o descriptor.safetensors
megloc serve my_map
megloc serve my_map --host 0.0.0.0 --token-file token.txt --workers 2
megloc submit aachen -i runs/aachen-megloc/localized -o poses.txt
megloc check aachen poses.txt --data runs/aachen-megloc
megloc evaluate -i localized --gt my_scene/query_gt -o evaluation
megloc evaluate -i localized -i refined --gt my_scene/query_gt
megloc export colmap -i my_map --query localized -o sparse/0
megloc export tum --query localized -o localized.tum
megloc view my_map --open
megloc view my_map localized --gt my_scene/query_gt -o view.html --rerun view.rrd
megloc train-field -i my_scene/mapping -o field --minutes 15
megloc render field --pose 1,0,0,0,0.2,0,1.5 --camera SIMPLE_PINHOLE,320,240,260,160,120 -o view.png
megloc render field --along localized -o rendered
megloc weights list
megloc weights fetch --preset modern
megloc weights add superpoint_v1.pth
megloc info my_map
megloc options localization.pose
megloc options aliked --preset modern
megloc doctor
"""
EXAMPLES = tuple(_TEXT.strip().splitlines())


def examples_text(arguments: Sequence[str]) -> str:
    """The end of the help page that these arguments ask for."""
    words = [word for word in arguments if not word.startswith("-")]
    found = [one for one in EXAMPLES if one.split()[1] in (words[:1] or ("localize", "eval"))]
    if not found:  # the command of a stage of another package
        found = [f"megloc {words[0]} -w runs/kapture-classic"]
    narrower = [one for one in found if one.split()[2:3] == words[1:2]]  # of megloc weights fetch
    return "\n".join(["examples:", *(f"  {one}" for one in (narrower or found)[:3])])
