"""Who sees whom: which view a texel, which texel what of the light."""

from svu_mi.visibility.observe import Observation as Observation
from svu_mi.visibility.observe import Surface as Surface
from svu_mi.visibility.observe import observe as observe
from svu_mi.visibility.observe import over_views as over_views
from svu_mi.visibility.survey import Survey as Survey
from svu_mi.visibility.survey import survey as survey
from svu_mi.visibility.views import Views as Views
from svu_mi.visibility.views import pack_sensors as pack_sensors
from svu_mi.visibility.views import pack_views as pack_views
