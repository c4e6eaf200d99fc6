"""The one estimator: parameters by name, covariances, the solver, `fit`, and what a fit cannot determine."""
