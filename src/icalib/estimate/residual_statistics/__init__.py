"""Statistics of the residuals after a fit: noise, covariances and cross-validation."""
