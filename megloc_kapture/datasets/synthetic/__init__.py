"""A rendered world with exact poses: the data of ``megloc eval synthetic`` and of the tests.

``build_world`` lays a world out, ``PlacePainter`` draws its shots, ``write_synthetic_kapture``
writes it as kapture; other layouts can be written from the same world and painter.
"""
