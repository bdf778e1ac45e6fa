"""What several tests use, and programs beside them: ``faults`` and ``kills``."""

import svu_mi  # noqa: F401 - first: it chooses LLVM
