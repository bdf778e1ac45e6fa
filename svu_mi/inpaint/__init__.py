"""What nobody saw: texels filled by likeness, with how sure that is."""

from svu_mi.inpaint.fill import Filled as Filled
from svu_mi.inpaint.fill import fill as fill
