"""The check of a pose file: that its challenge takes it, and that its poses are what they seem.

Unlike the readers beside it, which stop at the first thing that is wrong, this looks at the whole
file and reports every problem: broken rows, names, and the classic mistakes of pose conventions,
which it finds by comparing the poses with the map's cameras.
"""
