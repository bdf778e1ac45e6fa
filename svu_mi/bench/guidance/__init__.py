"""``svu bench guidance``: which views to photograph, and what each of them is worth.

``curves`` adds views to a start, one by one, by every strategy, and recovers textures from them;
``verdict`` says how many views each needs, and whether that is luck; ``speed`` times a step, and
what the same costs without rank-1 changes.
"""

from svu_mi.bench.guidance.plots import draw_guidance as draw_guidance
from svu_mi.bench.guidance.run import run_guidance as run_guidance
from svu_mi.bench.guidance.tables import guidance_tables as guidance_tables
