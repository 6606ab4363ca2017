"""Scalar kernels k(x, z) on one pair of points, and their algebra."""
