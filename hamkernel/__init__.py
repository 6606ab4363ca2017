"""Learn Hamiltonian dynamics with structured kernels."""
