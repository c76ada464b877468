"""What of a scanner's files goes on, and what is blanked or dropped as it may say whose it is."""
