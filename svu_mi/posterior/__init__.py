"""p(psi | B, L) on a grid of BRDF parameters, and its entropy."""

from svu_mi.posterior.angular import AngularKernel as AngularKernel
from svu_mi.posterior.angular import angular_grid as angular_grid
from svu_mi.posterior.angular import angular_posterior as angular_posterior
from svu_mi.posterior.calibrated import CalibratedKernel as CalibratedKernel
from svu_mi.posterior.calibrated import calibrated_posterior as calibrated_posterior
from svu_mi.posterior.grid import ParameterGrid as ParameterGrid
from svu_mi.posterior.grid import PrincipledGrid as PrincipledGrid
from svu_mi.posterior.posterior import Posterior as Posterior
from svu_mi.posterior.spectrum import SpectrumKernel as SpectrumKernel
from svu_mi.posterior.spectrum import spectrum_grid as spectrum_grid
from svu_mi.posterior.spectrum import spectrum_posterior as spectrum_posterior
from svu_mi.posterior.tabulated import tabulated_posterior as tabulated_posterior
