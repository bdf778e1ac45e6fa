"""How good an uncertainty is, against a reference posterior and against the truth; how good
recovered textures are, and pictures made with them.

Plain NumPy and SciPy. Nothing here returns NaN: where a figure is not defined, such as the
correlation with a constant, the docstring says what comes instead.
"""

from svu_mi.metrics.correlation import Interval as Interval
from svu_mi.metrics.correlation import mean_over_objects as mean_over_objects
from svu_mi.metrics.correlation import pearson as pearson
from svu_mi.metrics.correlation import sparsification as sparsification
from svu_mi.metrics.correlation import spearman as spearman
from svu_mi.metrics.credible import credible_coverage as credible_coverage
from svu_mi.metrics.credible import nearest_cells as nearest_cells
from svu_mi.metrics.images import image_error as image_error
from svu_mi.metrics.images import psnr as psnr
from svu_mi.metrics.images import texel_error as texel_error
from svu_mi.metrics.images import texture_psnr as texture_psnr
from svu_mi.metrics.truth import GroundTruth as GroundTruth
from svu_mi.metrics.truth import error_summary as error_summary
from svu_mi.metrics.truth import ground_truth as ground_truth
