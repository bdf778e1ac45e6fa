"""``python -m svu_mi`` is ``svu``."""

import sys

from svu_mi.cli.main import main

sys.exit(main())
