"""Quantiles of the chi-square distribution, by which squared Mahalanobis distances are accepted."""

from __future__ import annotations

# By degrees of freedom and probability: 99 % and 99.9 %.
CHI2_2DOF_99 = 9.21
CHI2_2DOF_999 = 13.8
CHI2_4DOF_999 = 18.5
