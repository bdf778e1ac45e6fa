"""What only developers measure; each is a command with the options of ``svu bench``.

    PYTHONPATH=tests python -m studies.NAME [--quick] [--data FOLDER] [-o FOLDER]

``kernels``: speed and error of every kernel. ``conventions``: how often ``svu check`` is right.
``orb``: Stanford-ORB, by its rules. ``switches``: every switch of the
estimators alone. ``paths``: light between parts of the object, and other noise.
``sharing``: recovery of materials that repeat, photographed mostly from one side.
``recovery_steps`` and ``guidance_steps``: what single steps cost.
"""

import svu_mi  # noqa: F401 - first: it chooses LLVM
