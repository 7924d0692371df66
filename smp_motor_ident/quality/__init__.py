# SPDX-License-Identifier: Apache-2.0
"""Detect faults of recordings, and repair those whose cause the recording shows."""
