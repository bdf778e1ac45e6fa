"""Texels of a UV-mapped mesh as surface points, their neighbours, gutters around their charts."""

from svu_mi.surface.layout import Texels as Texels
from svu_mi.surface.layout import texels as texels
from svu_mi.surface.neighbors import Neighbors as Neighbors
from svu_mi.surface.neighbors import neighbors as neighbors
