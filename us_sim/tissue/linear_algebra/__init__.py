"""Direct and iterative solutions of the large sparse systems of tissue."""
