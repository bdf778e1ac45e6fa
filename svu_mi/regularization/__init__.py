"""Regularisers: plain differentiable functions of texture tensors."""

from svu_mi.regularization.sharing import GlobalSharing as GlobalSharing
from svu_mi.regularization.tv import TotalVariation as TotalVariation
