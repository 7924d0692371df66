# SPDX-License-Identifier: Apache-2.0
"""Quantities of a fitted chain, their uncertainty, and findings about both."""
