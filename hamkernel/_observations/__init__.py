"""What was measured: linear functionals of a field and its potential, and their values."""
