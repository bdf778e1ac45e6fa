"""p(psi | B, L) on a grid of BRDF parameters, and its entropy."""

from svu_mi.posterior.angular import AngularPosterior as AngularPosterior
from svu_mi.posterior.angular import angular_grid as angular_grid
from svu_mi.posterior.angular import angular_posterior as angular_posterior
from svu_mi.posterior.calibrated import CalibratedPosterior as CalibratedPosterior
from svu_mi.posterior.calibrated import calibrated_posterior as calibrated_posterior
from svu_mi.posterior.grid import ParameterGrid as ParameterGrid
from svu_mi.posterior.grid import PrincipledGrid as PrincipledGrid
from svu_mi.posterior.record import Posterior as Posterior
from svu_mi.posterior.spectrum import SpectrumPosterior as SpectrumPosterior
from svu_mi.posterior.spectrum import spectrum_grid as spectrum_grid
from svu_mi.posterior.spectrum import spectrum_posterior as spectrum_posterior
from svu_mi.posterior.tabulated import TabulatedPosterior as TabulatedPosterior
