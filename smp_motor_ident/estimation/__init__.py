"""From prepared records to the fitted model: start, descent, choice among the ladder, certainty."""
