"""Command-line tools: arguments, progress and exit codes, nothing else."""
