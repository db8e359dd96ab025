"""Visual localization in kapture: MegLoc's stages as kapture plugins."""

# pycolmap 4.1.1 to 4.2.1 corrupt the heap when they are imported before zlib; this import
# must stay the first of the package (tests/test_import_order.py).
import zlib  # noqa: F401
