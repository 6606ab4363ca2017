"""What is learned: a vector field and its potential."""
