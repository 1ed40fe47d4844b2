"""How well the solution fits: noise, outliers, covariance from residuals."""
