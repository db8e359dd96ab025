"""Rendered datasets with exact poses: the data of ``megloc eval synthetic`` and of the tests.

``build_place`` lays a place out, ``PlaceRenderer`` renders its frames, and a
``SyntheticDataset`` writes them as kapture or in the official layout of a benchmark.
"""
