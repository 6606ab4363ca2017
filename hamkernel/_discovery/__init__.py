"""What the data say beyond the field: a formula of its potential, and which physics they obey."""
