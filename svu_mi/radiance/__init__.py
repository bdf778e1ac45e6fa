"""What each view shows of each texel, and the light that it reflects."""

from svu_mi.radiance.lighting import Lighting as Lighting
from svu_mi.radiance.lighting import light as light
from svu_mi.radiance.observe import Observation as Observation
from svu_mi.radiance.observe import Surface as Surface
from svu_mi.radiance.observe import coverage as coverage
from svu_mi.radiance.observe import observe as observe
from svu_mi.radiance.observe import over_views as over_views
from svu_mi.radiance.views import Views as Views
from svu_mi.radiance.views import pack_views as pack_views
