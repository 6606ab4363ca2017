"""Observations: linear functionals of a field and its potential, and their measured values."""
