"""Random Fourier features of structured kernels."""
