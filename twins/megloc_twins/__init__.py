"""Rendered datasets with exact poses: the data of ``megloc eval synthetic`` and of the tests.

``build_place`` builds a place, ``PlaceRenderer`` renders its frames, and a
``SyntheticDataset`` writes them as kapture or in the official layout of a benchmark.
"""
