"""Which conventions an export follows, and verdicts on it."""
