# SPDX-License-Identifier: Apache-2.0
"""Faults of recordings: found, and put right where the recording shows how."""
