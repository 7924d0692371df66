"""Knowing DC motors: from a recording to parameters, their certainty, and gains."""
