# SPDX-License-Identifier: Apache-2.0
"""Simulation of a chain on the rows of a record, for many sets of parameters at once."""
