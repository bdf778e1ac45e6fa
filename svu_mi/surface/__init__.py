"""Texels of the UV map as surface points, and gutters around their charts."""

from svu_mi.surface.layout import Texels as Texels
from svu_mi.surface.layout import texels as texels
