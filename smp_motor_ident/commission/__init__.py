# SPDX-License-Identifier: Apache-2.0
"""Checks and tests of the wheels of a running robot."""
