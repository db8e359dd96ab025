"""``python -m megloc_kapture``: the command ``megloc``."""

from megloc_kapture.cli.main import main

main()
