"""What only developers measure: kernels, ``svu check``, Stanford-ORB.

Each is a command with the options of ``svu bench``, run in a clone of the sources:

    PYTHONPATH=tests python -m studies.kernels [--quick] [-o FOLDER]
    PYTHONPATH=tests python -m studies.conventions [--data FOLDER] ...
    PYTHONPATH=tests python -m studies.orb [--data FOLDER] ...
"""

import svu_mi  # noqa: F401 - first: it chooses LLVM
