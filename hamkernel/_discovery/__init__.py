"""Beyond the field: a formula of its potential, and the physics that the data obey."""
