"""What data and results are worth: checks before, tests after, advice."""
