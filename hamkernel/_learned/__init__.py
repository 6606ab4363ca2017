"""Results of `learn`, and whether they may be used."""
