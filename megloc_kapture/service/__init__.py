"""Localization over HTTP, ``megloc serve``; needs the extra ``serve``."""
