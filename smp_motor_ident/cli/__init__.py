# SPDX-License-Identifier: Apache-2.0
"""Command-line tools: arguments, progress and exit codes, nothing else."""
