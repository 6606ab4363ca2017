"""What is known after measurements: fields and how far they may be off."""
