"""``python -m megloc_kapture``: the command ``megloc``."""

import sys

from megloc_kapture.cli.main import main

sys.exit(main())
