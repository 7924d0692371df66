# SPDX-License-Identifier: Apache-2.0
"""Identify DC motors from recordings, with uncertainties, and design gains."""
