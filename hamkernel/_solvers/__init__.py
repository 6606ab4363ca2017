"""Solvers: dense, by conjugate gradients, of low rank, and of data in a stream."""
