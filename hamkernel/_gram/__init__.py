"""The Gram of a kernel: dense, as an operator, and its derivatives."""
