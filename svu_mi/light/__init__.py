"""The light of a capture: read, filtered for lobes, gathered into cells."""

from svu_mi.light.cells import LightCells as LightCells
from svu_mi.light.cells import light_cells as light_cells
from svu_mi.light.levels import Levels as Levels
from svu_mi.light.levels import filter_light as filter_light
from svu_mi.light.lighting import Lighting as Lighting
from svu_mi.light.lighting import light as light
