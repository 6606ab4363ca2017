"""Matrix-valued kernels K = B [∂x ∂zᵀ k] Bᵀ, their sums, odd and even ones."""
