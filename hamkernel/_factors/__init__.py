"""Factors of A = G + ridge I, dense and of low rank, with the same few primitives."""
