"""What each view shows of each texel, and the light that it reflects."""

from svu_mi.radiance.cells import LightCells as LightCells
from svu_mi.radiance.cells import light_cells as light_cells
from svu_mi.radiance.hemisphere import Hemisphere as Hemisphere
from svu_mi.radiance.hemisphere import hemisphere as hemisphere
from svu_mi.radiance.levels import Levels as Levels
from svu_mi.radiance.levels import filter_light as filter_light
from svu_mi.radiance.lighting import Lighting as Lighting
from svu_mi.radiance.lighting import light as light
from svu_mi.radiance.observe import Observation as Observation
from svu_mi.radiance.observe import Surface as Surface
from svu_mi.radiance.observe import observe as observe
from svu_mi.radiance.observe import over_views as over_views
from svu_mi.radiance.survey import Survey as Survey
from svu_mi.radiance.survey import survey as survey
from svu_mi.radiance.views import Views as Views
from svu_mi.radiance.views import pack_sensors as pack_sensors
from svu_mi.radiance.views import pack_views as pack_views
