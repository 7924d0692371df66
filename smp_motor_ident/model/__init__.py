"""What a motor may be: candidate structures and their parameters."""
