"""Flux on a target under drift: error-function product and Monte Carlo."""
