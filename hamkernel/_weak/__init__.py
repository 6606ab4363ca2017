"""Learning by weak rows: laws that many parts share, and machines with unknown mass matrices."""
