"""Tissue that follows a hand: errors, residuals and times of every method, and a probe at rest."""
